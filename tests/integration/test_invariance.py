"""The result does not depend on who computed it, nor on the reward of the environment."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest

import oodil
from oodil.pipeline.algorithms.weights import transferability_of_logits
from oodil.pipeline.artifacts import read_artifact
from oodil.pipeline.environments.locomotion import HopperEnv
from oodil.pipeline.loading import load_config
from oodil.pipeline.results import ScoreHistory
from tests.runs import MICRO, LiveRun, artifacts, run

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
    changed = ("run", str(MICRO), NAIVE, "transferability.kept_from=0.25", "--run-dir", str(inline), "--workers", "0")
    code, output = LiveRun(*changed).finish()
    assert code == 2 and "finished with other settings (kept_from 0.5 -> 0.25); --force transferability" in output
    assert artifacts(inline) == before, "nothing is replaced unasked, and the folder keeps its configuration"
    output = run(*changed, "--force", "transferability")
    assert "imitators: reused" in output and "transferability: recomputed: kept_from 0.5 -> 0.25" in output
    assert "imitation: recomputed: its input transferability changed" in output
    assert "clustering: reused" in output and "naive_gail: reused" in output
    run("run", str(MICRO), NAIVE, "--run-dir", str(inline), "--workers", "0", "--force", "transferability")
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
    config = load_config(MICRO, [NAIVE, "environment.id=oodil/NanHopper-v0"])
    poisoned = oodil.run(config, workers=0, run_dir=tmp_path / "run")
    sound = oodil.open_run(inline)
    for stage_name, file in (
        ("transferability", "transferability.safetensors"),
        ("imitation", "policy.safetensors"),
        ("naive_gail", "policy.safetensors"),
    ):
        assert poisoned.artifact(stage_name).hashes[file] == sound.artifact(stage_name).hashes[file]
    assert np.isnan(poisoned.evaluation().mean_return)


def test_a_second_training_leaves_the_first_alone_and_the_closest_counts(inline: Path) -> None:
    before = artifacts(inline)
    again = ["transferability.num_trainings=2"]
    results = oodil.run(
        MICRO, [NAIVE, *again], workers=0, run_dir=inline, force=["imitators"], should_stop=lambda: False
    )
    jobs = inline / "jobs" / "transferability"
    readings = {path.name: ScoreHistory.load(read_artifact(path)) for path in jobs.iterdir()}
    firsts = [name for name in readings if "training" not in name]
    assert firsts
    for first in firsts:
        both = [readings[first], readings[f"{first}-training-2"]]
        last = [transferability_of_logits(reading.logits[-1]) for reading in both]
        assert not np.array_equal(*last), "both had the same luck"
        assert np.array_equal(results.transferability.scores[both[0].demonstrations], max(last, key=np.mean))
    oodil.run(MICRO, [NAIVE], workers=0, run_dir=inline, force=["imitators"])
    assert artifacts(inline) == before
