"""An environment that raises, crashes, exits, stalls and returns NaN now and then: the same bits as without."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from oodil.pipeline.data import Demonstrations
from oodil.pipeline.datasets import encode_demonstrations
from oodil.pipeline.environments import make_batch
from tests.flaky import FOLDER_VARIABLE, MISDEEDS, allow
from tests.runs import MICRO, LiveRun, artifacts, has_checkpoint, nothing_left, run, wait_for

pytestmark = pytest.mark.timeout(300)

FLAKY = "tests.flaky:FlakyPendulum-v0"


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Demonstrations of two swinging pendulums, and patience that fits a stalling simulator."""
    rng = np.random.default_rng(0)
    simulators = make_batch("Pendulum-v1", {}, 6)
    for g in range(6):
        simulators.reset(g, seed=g)
    states = []
    for _ in range(60):
        states.append(simulators.observations().astype(np.float32))
        simulators.step(rng.uniform(-2, 2, (6, 1)))
    lengths = [60] * 6
    demonstrations = Demonstrations(
        observations=np.concatenate(list(np.stack(states, axis=1))),
        offsets=np.cumsum([0, *lengths]).astype(np.int64),
        sources=np.zeros(6, np.int32),
        source_labels=("swinging",),
        returns=np.full(6, np.nan),
        terminated=np.zeros(6, np.bool_),
    )
    (tmp_path / "states.safetensors").write_bytes(encode_demonstrations(demonstrations, FLAKY))
    values = yaml.safe_load(MICRO.read_text())
    values |= {"environment": {"id": FLAKY}, "demonstrations": {"file": "states.safetensors"}}
    values["runtime"] |= {"max_attempts": 50, "max_worker_restarts": 50, "unit_timeout_s": 4, "job_timeout_s": 20}
    (tmp_path / "flaky.yaml").write_text(yaml.safe_dump(values))
    return tmp_path / "flaky.yaml"


def test_misdeeds_change_nothing(config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every misdeed is done once in the cluster jobs and once more in the final training."""
    misdeeds = tmp_path / "misdeeds"
    misdeeds.mkdir()
    monkeypatch.setenv(FOLDER_VARIABLE, str(misdeeds))
    run("run", str(config), "--run-dir", str(tmp_path / "calm"), "--workers", "2")
    allow(misdeeds, 0)
    live = LiveRun("run", str(config), "--run-dir", str(tmp_path / "flaky"), "--workers", "2")
    wait_for(has_checkpoint(tmp_path / "flaky", "imitation", "training-1", 1), "checkpoint")
    assert not list(misdeeds.iterdir()), "the cluster jobs were over before every misdeed was done"
    allow(misdeeds, 1)
    code, output = live.finish()
    assert code == 0, output
    nothing_left(live)
    done = 2 * len(MISDEEDS) - len(list(misdeeds.iterdir()))
    assert done >= 2 * len(MISDEEDS) - 1, output
    for sign in ("the simulator says no", "SIGSEGV", "exit code 3", "no progress for 20 s", "is not finite"):
        assert sign in output, output
    assert artifacts(tmp_path / "flaky") == artifacts(tmp_path / "calm")
