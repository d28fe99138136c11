"""A control of the transferability itself, with real training: the imitator's own dynamics come out as transferable.

Its counterpart, a policy that does nothing, is not held: docs/results.md has the figures and the reason.
"""

from pathlib import Path

import pytest

from pipeline.artifacts import RunDirectory, encode_arrays, write_artifact
from pipeline.data import Demonstrations
from pipeline.datasets import encode_demonstrations
from pipeline.environments import make_batch
from pipeline.evaluation import run_episodes
from pipeline.experts import load_expert
from pipeline.loading import parse_config
from pipeline.seeding import generator
from pipeline.stage import Run
from pipeline.stages.transferability import TransferabilityStage
from tests.runs import ROOT
from workers.engine import LocalEngine

pytestmark = pytest.mark.timeout(1200)

OWN = {"gravity": 9.8}
COUNT = 10


def test_own_dynamics_are_transferable(tmp_path: Path) -> None:
    expert, _ = load_expert(ROOT / "configs" / "experts" / "hopper-gravity-9.8")
    simulators = make_batch("oodil/Hopper-v0", OWN, COUNT)
    episodes = run_episodes(simulators, expert, generator((0,)), stochastic=False)
    demonstrations = Demonstrations.of(episodes, "own dynamics")
    file = tmp_path / "demonstrations.safetensors"
    file.write_bytes(encode_demonstrations(demonstrations, "oodil/Hopper-v0"))
    values = {
        "name": "controls",
        "environment": {"id": "oodil/Hopper-v0", "dynamics": OWN},
        "demonstrations": {"file": str(file)},
        "transferability": {"gail": {"total_steps": 1_000_000}},
        "imitation": {"gail": {"total_steps": 1}},
    }
    config = parse_config(values, "controls")
    run = Run(config, RunDirectory(tmp_path / "run"))
    run.directory.path.mkdir()
    run.directory.config.write_text(config.model_dump_json())
    write_artifact(run.directory.stage("demonstrations"), {}, {file.name: file.read_bytes()})
    labels = encode_arrays({"labels": demonstrations.sources})
    write_artifact(run.directory.stage("clustering"), {}, {"assignment.safetensors": labels})

    stage = TransferabilityStage()
    outcome = LocalEngine(1).run_jobs(stage, run, stage.jobs(run), lambda _: None, lambda: False)
    assert not outcome.failed, outcome.failed
    write_artifact(run.directory.stage(stage.name), {}, stage.combine(run))
    scores = run.artifact(stage.name).arrays("transferability.safetensors")["scores"]
    assert scores.min() > 0.1, scores
