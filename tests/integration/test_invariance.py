"""The result does not depend on who computed it, nor on the reward of the environment."""

import json
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from safetensors.numpy import load_file

from oodil.pipeline.algorithms.weights import transferability_of_logits
from oodil.pipeline.environments.locomotion import HopperEnv
from oodil.pipeline.loading import load_config
from tests.runs import MICRO, artifacts, run

pytestmark = pytest.mark.timeout(600)
NAIVE = "baselines=[naive_gail]"


@pytest.fixture(scope="module")
def inline(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run without any worker."""
    run_dir = tmp_path_factory.mktemp("inline") / "run"
    run("run", str(MICRO), NAIVE, "--run-dir", str(run_dir), "--workers", "0")
    return run_dir


@pytest.mark.parametrize("workers", [1, 2, 4])
def test_the_number_of_workers_does_not_change_a_bit(inline: Path, tmp_path: Path, workers: int) -> None:
    run("run", str(MICRO), NAIVE, "--run-dir", str(tmp_path / "run"), "--workers", str(workers))
    assert artifacts(tmp_path / "run") == artifacts(inline)


def test_a_finished_run_is_reused_and_a_changed_field_recomputes_what_follows(inline: Path) -> None:
    before = artifacts(inline)
    output = run("run", str(MICRO), NAIVE, "--run-dir", str(inline), "--workers", "0")
    assert output.count("reused") == len(before)
    output = run("run", str(MICRO), NAIVE, "transferability.sharpening=1", "--run-dir", str(inline), "--workers", "0")
    assert "transferability: recomputed: sharpening 4.0 -> 1.0" in output
    assert "imitation: recomputed: its input transferability changed" in output
    assert "clustering: reused" in output and "naive_gail: reused" in output
    run("run", str(MICRO), NAIVE, "--run-dir", str(inline), "--workers", "0")
    assert artifacts(inline) == before


def test_a_damaged_artifact_is_named_and_recomputed(inline: Path) -> None:
    before = artifacts(inline)
    policy = inline / "stages" / "imitation" / "policy.safetensors"
    content = bytearray(policy.read_bytes())
    content[-1] ^= 1
    policy.write_bytes(content)
    output = run("resume", str(inline), "--workers", "0")
    assert f"imitation: recomputed: {policy}" in output
    assert artifacts(inline) == before


class NanHopper(HopperEnv):
    """Hopper whose own reward is of no use."""

    def __init__(self, gravity: float) -> None:
        super().__init__(gravity, forward_reward_weight=float("nan"))


def test_a_reward_of_nan_trains_to_the_same_bits(inline: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gymnasium.register("oodil/NanHopper-v0", entry_point=NanHopper, max_episode_steps=1000)
    from oodil.pipeline.artifacts import RunDirectory
    from oodil.pipeline.stage import Run
    from oodil.pipeline.stages import stages
    from oodil.workers.engine import LocalEngine

    config = load_config(MICRO, [NAIVE, "environment.id=oodil/NanHopper-v0"])
    poisoned = Run(config, RunDirectory(tmp_path / "run"))
    sound = Run(load_config(MICRO, [NAIVE]), RunDirectory(inline))
    from oodil.pipeline.artifacts import write_artifact

    for stage in stages(config):
        outcome = LocalEngine(0).run_jobs(stage, poisoned, stage.jobs(poisoned), lambda _: None, lambda: False)
        assert not outcome.failed, outcome.failed
        files = stage.combine(poisoned)
        if files is not None:
            write_artifact(poisoned.directory.stage(stage.name), stage.origin(poisoned), files)
    for stage_name, file in (
        ("transferability", "transferability.safetensors"),
        ("imitation", "policy.safetensors"),
        ("naive_gail", "policy.safetensors"),
    ):
        assert poisoned.artifact(stage_name).hashes[file] == sound.artifact(stage_name).hashes[file]
    evaluation = poisoned.artifact("imitation").json("evaluation.json")
    assert evaluation["final_return"] is None


def test_a_second_training_leaves_the_first_alone_and_the_closest_counts(inline: Path) -> None:
    before = artifacts(inline)
    run("run", str(MICRO), NAIVE, "transferability.num_trainings=2", "--run-dir", str(inline), "--workers", "0")
    scores = load_file(inline / "stages" / "transferability" / "transferability.safetensors")["scores"]
    jobs = inline / "jobs" / "transferability"
    every = [load_file(path / "scores.safetensors")["env_steps"][-1] for path in jobs.iterdir()]
    summary = json.loads((inline / "stages" / "transferability" / "summary.json").read_text())
    assert summary["env_steps"] == sum(every)
    firsts = [path for path in jobs.iterdir() if "training" not in path.name]
    assert firsts
    for first in firsts:
        trained = [load_file(path / "scores.safetensors") for path in (first, jobs / f"{first.name}-training-2")]
        last = [transferability_of_logits(training["logits"][-1]) for training in trained]
        assert not np.array_equal(*last), "both had the same luck"
        assert np.array_equal(scores[trained[0]["demonstrations"]], max(last, key=np.mean))
    run("run", str(MICRO), NAIVE, "--run-dir", str(inline), "--workers", "0")
    assert artifacts(inline) == before
