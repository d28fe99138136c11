"""The result does not depend on who computed it, nor on the reward of the environment."""

import shutil
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import oodil
from oodil.pipeline.algorithms.weights import share_lasted, transferability_of_divergences
from oodil.pipeline.environments.locomotion import HopperEnv
from oodil.pipeline.evaluation import evaluate
from oodil.pipeline.loading import load_config
from oodil.pipeline.results import Imitator, LearningCurve, Reading, Trainings
from oodil.pipeline.seeding import derive_key
from oodil.workers.channels import endpoint_folder
from tests.runs import MICRO, LiveRun, artifacts, has_checkpoint, nothing_left, run, wait_for

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


@pytest.mark.parametrize("stage", ["imitators", "transferability"])
def test_a_stage_is_no_more_sound_than_those_of_its_jobs_that_are_read_later(inline: Path, stage: str) -> None:
    """`oodil score` and a policy that goes on from an imitator read them."""
    before = artifacts(inline)
    job = sorted((inline / "jobs" / stage).iterdir())[0]
    networks = next(job.glob("*.safetensors"))
    networks.write_bytes(networks.read_bytes()[:-1])
    assert oodil.open_run(inline).describe()["stages"][stage]["state"] == "damaged"
    output = run("resume", str(inline), "--workers", "0")
    assert f"{stage}: recomputed: {job}" in output
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
    names = [path.name for path in (inline / "jobs" / "transferability").iterdir()]
    readings = {name: Reading.load(results.run.job_artifact("transferability", name)) for name in names}
    imitators = {name: Imitator.load(results.run.job_artifact("imitators", name)) for name in names}
    firsts = [name for name in names if "training" not in name]
    assert firsts
    for first in firsts:
        both = [first, f"{first}-training-2"]
        assert imitators[both[0]].distance != imitators[both[1]].distance, "both had the same luck"
        assert not np.array_equal(*(readings[name].divergences for name in both))
        closest = readings[min(both, key=lambda name: imitators[name].distance)]
        own = results.demonstrations.select(closest.demonstrations)
        expected = transferability_of_divergences(closest.divergences) * share_lasted(own, 1000)
        assert np.array_equal(results.transferability.scores[closest.demonstrations], expected.mean(axis=0))
    oodil.run(MICRO, [NAIVE], workers=0, run_dir=inline, force=["imitators"])
    assert artifacts(inline) == before


TWO = "imitation.num_trainings=2"


@pytest.fixture(scope="module")
def inline_twice(inline: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, int]]:
    """The run without any worker, trained once more; with it, when the first trainings were written."""
    run_dir = tmp_path_factory.mktemp("twice") / "run"
    shutil.copytree(inline, run_dir)
    firsts = {name: written(run_dir, name) for name in POLICIES}
    forced = [argument for name in POLICIES for argument in ("--force", name)]
    run("run", str(MICRO), NAIVE, TWO, "--run-dir", str(run_dir), "--workers", "0", *forced)
    return run_dir, firsts


POLICIES = ("imitation", "naive_gail")


def written(run_dir: Path, policy: str) -> int:
    """Return when a policy's first training was written."""
    return (run_dir / "jobs" / policy / "training-1").stat().st_mtime_ns


def test_one_more_training_of_a_policy_reuses_the_first_and_the_closest_is_kept(
    inline: Path, inline_twice: tuple[Path, dict[str, int]]
) -> None:
    run_dir, firsts = inline_twice
    before, results = artifacts(inline), oodil.open_run(run_dir)
    assert {name: written(run_dir, name) for name in POLICIES} == firsts
    for name, sha256 in artifacts(run_dir).items():
        assert (sha256 == before[name]) == (name not in POLICIES), name
    for name in POLICIES:
        jobs = {job: results.run.job_artifact(name, job) for job in ("training-1", "training-2")}
        assert jobs["training-1"].sha256 == oodil.open_run(inline).run.job_artifact(name, "training-1").sha256
        trainings = Trainings.load(results.artifact(name)).trainings
        assert sorted(training.job for training in trainings) == sorted(jobs)
        assert trainings[0].distance < trainings[1].distance
        steps = results.policy(name).env_steps
        assert all(steps / 2 < each.kept_after <= steps < each.env_steps for each in trainings)
        kept = jobs[trainings[0].job]
        assert results.artifact(name).hashes["policy.safetensors"] == kept.hashes["policy.safetensors"]
        one, two = (artifact.hashes["policy.safetensors"] for artifact in jobs.values())
        assert one != two, "both have the same seed"
        begun = [LearningCurve.load(artifact).env_steps[0] == 0 for artifact in jobs.values()]
        assert begun == [name == "imitation", False], "the second training begins anew, whatever the first does"


@pytest.mark.parametrize("workers", [1, 4])
def test_trainings_that_rollout_workers_collect_for_give_the_same_bits(
    inline_twice: tuple[Path, dict[str, int]], tmp_path: Path, workers: int
) -> None:
    """With one worker the two trainings come one after another, each on its own; with four, workers collect."""
    run("run", str(MICRO), NAIVE, TWO, "--run-dir", str(tmp_path / "run"), "--workers", str(workers))
    assert bool(list((tmp_path / "run" / "logs").glob("imitation-rollout-worker-*"))) == (workers == 4)
    assert artifacts(tmp_path / "run") == artifacts(inline_twice[0])


def test_trainings_run_side_by_side_and_after_a_kill_give_the_same_bits(
    inline_twice: tuple[Path, dict[str, int]], tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    live = LiveRun("run", str(MICRO), NAIVE, TWO, "--run-dir", str(run_dir), "--workers", "2")
    for job in ("training-1", "training-2"):
        wait_for(has_checkpoint(run_dir, "imitation", job, 4), "checkpoint")
    sides = [live.child(f"imitation-training-{n}") for n in (1, 2)]
    assert all(side.is_running() for side in sides), "one had ended before the other began"
    assert not endpoint_folder(run_dir).exists()
    live.kill_group()
    nothing_left(live)
    assert not (run_dir / "jobs" / "imitation").exists(), "a training had finished"
    output = run("resume", str(run_dir), "--workers", "2")
    begun = next(line for line in output.splitlines() if "▶ imitation" in line)
    assert "resumed from checkpoint" in begun
    assert not list((run_dir / "logs").glob("*rollout-worker*"))
    assert artifacts(run_dir) == artifacts(inline_twice[0])


def test_our_policy_goes_on_from_the_imitator_of_what_it_draws_most_and_others_begin_anew(
    inline: Path, tmp_path: Path
) -> None:
    results = oodil.open_run(inline)
    found = results.transferability
    lengths = results.demonstrations.lengths - 1
    drawn = {cluster: (found.weights * lengths)[found.clusters == cluster].sum() for cluster in found.read_from}
    cluster = max(drawn, key=lambda each: drawn[each])
    begun = Imitator.load(results.run.job_artifact("imitators", found.read_from[cluster]))
    config = results.config
    environment, key = config.environment, derive_key(config.seed, "curve")
    seen = evaluate(begun.policy, environment.id, environment.dynamics, config.evaluation.episodes, key)
    curves = {name: results.curve(name) for name in POLICIES}
    assert (curves["imitation"].env_steps[0], curves["imitation"].mean_return[0]) == (0, seen.mean_return)
    assert len(curves["imitation"].env_steps) == len(curves["naive_gail"].env_steps) + 1
    shutil.copytree(inline, tmp_path / "run")
    anew = [NAIVE, "imitation.warm_start=false"]
    assert oodil.run(MICRO, anew, workers=0, run_dir=tmp_path / "run", force=["imitation"]).curve().env_steps[0] > 0
