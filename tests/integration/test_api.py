"""``import oodil``: what a script, a thread or a notebook can do."""

import subprocess
import sys
import threading
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

import oodil
from oodil.pipeline.results import Policy
from tests.runs import MICRO

pytestmark = pytest.mark.timeout(300)
HEAVY = {"torch", "numpy", "mujoco", "gymnasium", "pydantic", "sklearn", "zmq", "matplotlib"}


class Recorder(oodil.Observer):
    """Notes what it is told."""

    def __init__(self) -> None:
        self.told: list[tuple[str, str]] = []
        self.events = 0

    def stage_reused(self, stage: str) -> None:
        self.told.append(("reused", stage))

    def stage_started(self, stage: str, reason: str, jobs: int) -> None:
        self.told.append(("started", stage))

    def stage_finished(self, stage: str, seconds: float) -> None:
        self.told.append(("finished", stage))

    def event(self, event: object) -> None:
        self.events += 1


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> oodil.RunResults:
    """A finished run, made in a thread that is not the main one, with worker processes."""
    path = tmp_path_factory.mktemp("api") / "run"
    made: list[oodil.RunResults] = []
    thread = threading.Thread(target=lambda: made.append(oodil.run(MICRO, ["seed=3"], workers=2, run_dir=path)))
    thread.start()
    thread.join()
    return made[0]


def test_importing_loads_nothing_heavy() -> None:
    probe = "import sys, oodil; print(*{name.split('.')[0] for name in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", probe], check=True, capture_output=True, text=True).stdout.split()
    assert "oodil" in loaded and not HEAVY & set(loaded)


def test_everything_public_is_there_and_documented() -> None:
    for name in oodil.__all__:
        assert getattr(oodil, name).__doc__, name
    assert set(oodil.__all__) < set(dir(oodil))
    with pytest.raises(AttributeError, match="no attribute 'scor'"):
        oodil.scor  # noqa: B018


def test_an_observer_is_told_and_a_finished_run_is_reused(results: oodil.RunResults) -> None:
    recorder = Recorder()
    again = oodil.run(MICRO, ["seed=3"], workers=0, run_dir=results.path, observer=recorder)
    stages = ["demonstrations", "clustering", "imitators", "transferability", "imitation"]
    assert recorder.told == [("reused", stage) for stage in stages]
    assert again.describe()["stages"] == results.describe()["stages"]
    forced = Recorder()
    oodil.run(MICRO, ["seed=3"], workers=0, run_dir=results.path, observer=forced, force=["transferability"])
    assert forced.told[3:] == [("started", "transferability"), ("finished", "transferability"), ("reused", "imitation")]
    assert forced.events


def test_a_stage_that_was_to_be_computed_again_is_not_finished_if_that_was_stopped(tmp_path: Path) -> None:
    until = {"workers": 0, "run_dir": tmp_path, "until": "demonstrations"}
    before = oodil.run(MICRO, **until).artifact("demonstrations")
    with pytest.raises(oodil.UnfinishedError):
        oodil.run(MICRO, **until, force=["demonstrations"], should_stop=lambda: True)
    assert not oodil.open_run(tmp_path).is_done("demonstrations")
    again = oodil.run(MICRO, **until)
    assert again.artifact("demonstrations").sha256 == before.sha256
    assert all((tmp_path / "jobs" / "demonstrations" / f"source-{i}" / "manifest.json").is_file() for i in (0, 1))


def test_a_stop_is_heard_and_the_run_goes_on(results: oodil.RunResults, tmp_path: Path) -> None:
    with pytest.raises(oodil.UnfinishedError, match="oodil resume"):
        oodil.run(MICRO, ["seed=3"], workers=0, run_dir=tmp_path / "run", should_stop=lambda: True)
    resumed = oodil.run(MICRO, ["seed=3"], workers=0, run_dir=tmp_path / "run")
    for stage, entry in resumed.describe()["stages"].items():
        assert entry["sha256"] == results.describe()["stages"][stage]["sha256"]


def test_what_a_run_holds_is_typed(results: oodil.RunResults) -> None:
    opened = oodil.open_run(results.path)
    assert len(opened.demonstrations) == 7 and opened.demonstrations.source_labels == ("fast", "slow")
    assert opened.assignment.labels.shape == (7,)
    assert opened.cluster_diagnostics.num_clusters == 2
    rows = opened.transferability.table()
    assert [row["demonstration"] for row in rows] == list(range(7))
    assert sum(row["weight"] for row in rows) == pytest.approx(1)
    assert opened.table()[6]["source"] == "slow" and opened.table()[6]["states"] == 1001
    assert len(opened.evaluation()) == 2 and opened.curve().env_steps[-1] == opened.policy().env_steps


def test_the_policy_acts_as_its_training_did(results: oodil.RunResults) -> None:
    policy = results.policy()
    env = gymnasium.make("oodil/Hopper-v0", gravity=12.0)
    observation, _ = env.reset(seed=0)
    action = policy.act(observation)
    assert env.action_space.contains(action)
    far = policy.gaussian.mean(observation[None])[0]
    np.testing.assert_array_equal(action, np.clip(far, -1, 1))
    batch = policy.act(np.stack([observation, observation]))
    # The rounding of a sum goes by its terms: an action near zero has that of one near 1.
    np.testing.assert_allclose(batch, [action, action], rtol=1e-6, atol=np.finfo(np.float32).eps)
    with pytest.raises(oodil.OodilError, match=r"shape \(11,\); the policy was trained on \(12,\)"):
        policy.act(observation[1:])


def test_observations_are_flattened_actions_shaped_and_clipped() -> None:
    from oodil.pipeline.policy import GaussianPolicy

    gaussian = GaussianPolicy(
        weights=(np.eye(4, dtype=np.float32),),
        biases=(np.zeros(4, np.float32),),
        log_std=np.zeros(4, np.float32),
        input_mean=np.zeros(4, np.float32),
        input_scale=np.ones(4, np.float32),
    )
    low, high = np.full((2, 2), -np.inf, np.float32), np.array([[1, 1], [2, np.inf]], np.float32)
    policy = Policy(gaussian, "toy/Square-v0", (2, 2), low, high)
    seen = np.array([[-5.0, 0.5], [3.0, 9.0]])
    np.testing.assert_allclose(policy.act(seen), [[-5, 0.5], [2, 9]])
    assert policy.act(np.stack([seen] * 3)).shape == (3, 2, 2)


def test_stable_baselines3_evaluates_it(results: oodil.RunResults) -> None:
    env = DummyVecEnv([lambda: gymnasium.make("oodil/Hopper-v0", gravity=12.0) for _ in range(2)])
    mean, std = evaluate_policy(results.policy(), env, n_eval_episodes=4, warn=False)
    ours = oodil.evaluate(results.policy(), "oodil/Hopper-v0", {"gravity": 12.0}, episodes=16)
    assert np.isfinite(std) and abs(mean - ours.mean_return) < 4 * ours.std_return + 50


@pytest.mark.parametrize(
    "program",
    [
        "import gymnasium; env = gymnasium.make('oodil:oodil/Hopper-v0', gravity=12.0)",
        "import gymnasium, oodil; env = gymnasium.make('oodil/Hopper-v0', gravity=12.0)",
        "import oodil; oodil.evaluate; import gymnasium; env = gymnasium.make('oodil/Hopper-v0', gravity=12.0)",
    ],
)
def test_gymnasium_knows_our_environments(program: str) -> None:
    probe = f"{program}; print(env.unwrapped.model.opt.gravity[2])"
    shown = subprocess.run([sys.executable, "-c", probe], check=True, capture_output=True, text=True)
    assert shown.stdout.strip() == "-12.0" and "WARN" not in shown.stderr
