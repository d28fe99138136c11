"""The whole pipeline on an environment that is not ours, from a file of states to a policy."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from oodil.pipeline.data import Demonstrations
from oodil.pipeline.datasets import encode_demonstrations
from oodil.pipeline.environments import make_batch
from oodil.pipeline.evaluation import run_episodes
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.seeding import numpy_rng
from tests.runs import MICRO, LiveRun, artifacts, has_checkpoint, nothing_left, run, wait_for

pytestmark = pytest.mark.timeout(300)
PENDULUM = "Pendulum-v1"


def pushing(strength: float, gravity: float) -> Demonstrations:
    """Pendulums of a demonstrator that pushes with the rotation."""
    policy = GaussianPolicy(
        weights=(np.array([[0.0], [0.0], [strength]], np.float32),),
        biases=(np.zeros(1, np.float32),),
        log_std=np.zeros(1, np.float32),
        input_mean=np.zeros(3, np.float32),
        input_scale=np.ones(3, np.float32),
    )
    simulators = make_batch(PENDULUM, {"g": gravity}, 4)
    return Demonstrations.of(run_episodes(simulators, policy, numpy_rng((0,)), stochastic=False), f"g {gravity}")


@pytest.fixture
def config(tmp_path: Path) -> Path:
    demonstrations = Demonstrations.joined([pushing(1.0, 10.0), pushing(0.2, 2.0)])
    (tmp_path / "states.safetensors").write_bytes(encode_demonstrations(demonstrations, PENDULUM))
    values = yaml.safe_load(MICRO.read_text())
    values |= {"environment": {"id": PENDULUM, "dynamics": {"g": 9.0}}, "baselines": []}
    values["demonstrations"] = {"file": "states.safetensors"}
    (tmp_path / "pendulum.yaml").write_text(yaml.safe_dump(values))
    return tmp_path / "pendulum.yaml"


def test_any_number_of_workers_and_a_kill_give_the_same_bits(config: Path, tmp_path: Path) -> None:
    run("run", str(config), "--run-dir", str(tmp_path / "inline"), "--workers", "0")
    live = LiveRun("run", str(config), "--run-dir", str(tmp_path / "killed"), "--workers", "2")
    wait_for(has_checkpoint(tmp_path / "killed", "imitation", "training-1", 5), "checkpoint")
    live.kill_group()
    nothing_left(live)
    run("resume", str(tmp_path / "killed"), "--workers", "1")
    assert artifacts(tmp_path / "killed") == artifacts(tmp_path / "inline")
