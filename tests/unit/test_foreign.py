"""Environments as people have them: used as they are meant, or refused before any work with what is wrong."""

from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest

import tests.odd_environments
from oodil.pipeline.config import EnvironmentConfig
from oodil.pipeline.environments import check_environment, environment_spec, make_batch, replay
from oodil.pipeline.errors import UnusableEnvironmentError
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.records import EPISODES, random_return
from oodil.pipeline.results import Policy

ODD = "tests.odd_environments:odd/{}-v0"


def given(name: str, action: list[float]) -> Any:
    """Return what an environment is given for an action in units."""
    batch: Any = make_batch(ODD.format(name), {}, 2)
    for g in range(2):
        batch.reset(g, seed=g)
    batch.step(np.array([action, [0, 0, 0]], np.float32))
    return batch._environments[0]._env.unwrapped.given


def test_actions_are_in_units_of_their_bounds_and_raw_where_there_are_none() -> None:
    """Bounds are [-600, 200], [2, 6] and (-inf, 1]."""
    assert given("Newtons", [0.0, 0.0, 0.0]).tolist() == [-200.0, 4.0, 0.0]
    assert given("Newtons", [0.5, -1.0, -30.0]).tolist() == [0.0, 2.0, -30.0]
    assert given("Newtons", [-1.5, 1.5, 1.5]).tolist() == [-600.0, 6.0, 1.0]
    spec = check_environment(ODD.format("Newtons"), {})
    low, high = spec.bounds()
    assert low.tolist() == [-1.0, -1.0, -np.inf] and high.tolist() == [1.0, 1.0, 1.0]
    assert spec.action_low.tolist() == [-600.0, 2.0, -np.inf]


def test_whole_actions_are_rounded() -> None:
    assert given("Gears", [0.5, -0.29, 2.0]).tolist() == [2, -1, 5]


def test_a_policy_acts_in_the_numbers_of_the_environment() -> None:
    spec = environment_spec(ODD.format("Newtons"), {})
    gaussian = GaussianPolicy(
        weights=(np.zeros((6, 3), np.float32),),
        biases=(np.array([0.25, -2.0, -7.0], np.float32),),
        log_std=np.zeros(3, np.float32),
        input_mean=np.zeros(6, np.float32),
        input_scale=np.ones(6, np.float32),
    )
    policy = Policy(gaussian, "", spec.observation_shape, spec.action_low, spec.action_high)
    assert policy.act(np.zeros(6)).tolist() == [-100.0, 2.0, -7.0]
    ours = replace(policy, action_low=-np.ones(3, np.float32), action_high=np.ones(3, np.float32))
    assert ours.act(np.zeros(6)).tolist() == [0.25, -1.0, -1.0]


def test_a_policy_gives_whole_numbers_where_the_environment_takes_no_others() -> None:
    """What it gives is what its training applied: 2.5 -> 2, -1.45 -> -1, and no further than 5."""
    in_units = [0.5, -0.29, 2.0]
    spec = environment_spec(ODD.format("Gears"), {})
    gaussian = GaussianPolicy(
        weights=(np.zeros((6, 3), np.float32),),
        biases=(np.array(in_units, np.float32),),
        log_std=np.zeros(3, np.float32),
        input_mean=np.zeros(6, np.float32),
        input_scale=np.ones(6, np.float32),
    )
    policy = Policy(gaussian, "", (6,), spec.action_low, spec.action_high, acts_in_integers=spec.acts_in_integers)
    assert policy.act(np.zeros(6)).tolist() == given("Gears", in_units).tolist() == [2, -1, 5]
    assert not environment_spec(ODD.format("Newtons"), {}).acts_in_integers


def test_random_actions_reach_as_far_in_newtons() -> None:
    carts, strong = (random_return(EnvironmentConfig(id=ODD.format(name))) for name in ("Carts", "Strong"))
    assert strong == pytest.approx(carts, rel=1e-5)


def test_an_environment_that_ends_the_process_is_refused() -> None:
    with pytest.raises(UnusableEnvironmentError, match=r"step 3 of an episode: raised SystemExit: the simulator left"):
        check_environment(ODD.format("Leaves"), {})


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Broadcast", r"start of an episode: it observes an array of shape \(2,\), but .* declares \(6,\)"),
        ("LaterColumn", r"step 7 of an episode: it observes an array of shape \(6, 1\), but .* declares \(6,\)"),
        ("Words", "it observes a list, but .* declares float32"),
        ("Fractions", "it observes float32 numbers, but .* declares int32"),
        ("Infinite", "step 12 of an episode.* not finite"),
        ("NoReward", "step 1 of an episode: the reward is None"),
        ("Crashes", "step 18 of an episode: raised ConnectionError: no answer from the robot"),
        ("Unseeded", "start of an episode: .*Gym before 0.26.*seed=None"),
        ("Bare", "start of an episode: reset returned a ndarray; .*Gym before 0.26"),
        ("Four", "step 1 of an episode: .*Gym before 0.26.*terminated, truncated"),
        ("LateDraw", "is not deterministic: an episode of 60 steps, .* differed at step 45;"),
        ("Worn", "is not deterministic: .* differed at step 1; .*reset must leave nothing"),
        ("Pixels", r"observations are images \(uint8 of shape \(12, 10, 3\), 360 numbers\)"),
        ("FloatPixels", r"observations are images \(float32 of shape \(3, 20, 16\), 960 numbers\)"),
        ("Scan", r"observations are float32 of shape \(1081,\), 1081 numbers; at most 1000"),
        ("Named", "FlattenObservation.* in this order, place, velocity"),
        ("NoFile", r"No such file or directory: 'robots/arm.urdf'; it is looked for in .*__file__"),
        ("Endless", "nothing ended an episode of 10000 steps, and its time limit is 10000000 steps.*max_episode_steps"),
    ],
)
def test_what_does_not_do_what_it_declares_is_refused(name: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay, "_TRIAL_S", np.inf)  # However slow the machine, a trial takes all its steps.
    env_id = ODD.format(name)
    with pytest.raises(UnusableEnvironmentError, match=f"^environment '{env_id}'.*{message}") as refused:
        check_environment(env_id, {})
    assert "\n" not in str(refused.value)


def test_one_that_a_process_can_hold_once_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tests.odd_environments.Single, "opened", 0)
    message = r"made only once in a process .OSError: the device is busy.*cannot be used"
    with pytest.raises(UnusableEnvironmentError, match=message):
        check_environment(ODD.format("Single"), {})


def test_simulators_that_nobody_holds_any_more_are_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """They may hold a process, a client or a file, and a training makes hundreds."""
    closed: list[object] = []
    monkeypatch.setattr(tests.odd_environments.Carts, "close", lambda env: closed.append(env))
    random_return(EnvironmentConfig(id=ODD.format("Strong")))
    count = len(closed)
    assert count >= EPISODES
    batch = make_batch(ODD.format("Strong"), {}, 2)
    batch.close()
    batch.close()
    del batch
    assert len(closed) == count + 2


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("Walker2d-v3", "cannot be made: .*there is Walker2d-v5"),
        ("Acrobot-v0", "cannot be made: .*Acrobot-v1"),
        (
            "no_such_robot:Arm-v0",
            r"No module named .no_such_robot.* no_such_robot has to lie beside the configuration",
        ),
    ],
)
def test_ids_of_old_and_missing_modules_are_told_what_to_do(env_id: str, message: str) -> None:
    with pytest.raises(UnusableEnvironmentError, match=message):
        check_environment(env_id, {})


def test_what_the_trial_does_not_find_is_found_when_an_episode_is_played_again() -> None:
    """Carts that are pushed to one side get where random pushes do not."""
    env_id = ODD.format("Far")
    check_environment(env_id, {})
    one, two = make_batch(env_id, {}, 3), make_batch(env_id, {}, 3)
    for g in range(3):
        one.reset(g, seed=3 + g)
    for _ in range(60):
        one.step(np.ones((3, 3)))
    with pytest.raises(UnusableEnvironmentError, match=r"is not deterministic: an episode of 60 steps.* at step"):
        two.restore(one.snapshot())
    with pytest.raises(UnusableEnvironmentError, match=r"is not deterministic: an episode of 60 steps.* at step"):
        one.reset(0, seed=7)


def test_what_is_saved_is_what_was_played_whatever_the_limit() -> None:
    """Three actions and a mark for each step, behind a seed and a mark."""
    env_id = "tests.odd_environments:odd/Long-v0"
    spec = check_environment(env_id, {})
    assert spec.max_episode_steps == 10**9
    batch, other = make_batch(env_id, {}, 2), make_batch(env_id, {}, 2)
    for g in range(2):
        batch.reset(g, seed=g)
    for _ in range(25):
        batch.step(np.full((2, 3), 0.5))
    batch.reset(1, seed=5)
    snapshot = batch.snapshot()
    assert snapshot.states.shape == (2, 2 + 25 * 4)
    other.restore(snapshot)
    assert other.observations().tobytes() == batch.observations().tobytes()
    for _ in range(100):
        outcome = batch.step(np.zeros((2, 3)))
    assert outcome.truncated.all() and batch.elapsed_steps().tolist() == [40, 40]


def test_a_step_that_raised_is_not_taken_for_where_it_began() -> None:
    env_id = ODD.format("Infinite")
    batch = make_batch(env_id, {}, 1)
    batch.reset(0, seed=0)
    for _ in range(11):
        batch.step(np.zeros((1, 3)))
    here = batch.snapshot()
    with pytest.raises(FloatingPointError, match="step 12 of an episode"):
        batch.step(np.zeros((1, 3)))
    batch.restore(here)
    with pytest.raises(FloatingPointError, match="step 12 of an episode"):
        batch.step(np.zeros((1, 3)))


def test_dynamics_are_whatever_json_holds() -> None:
    dynamics: dict[str, Any] = {
        "substeps": 3,
        "start": "right",
        "masses": [1, 2.5, True, None],
        "options": {"deep": [{"er": "1.5.2"}], "small": "2e-4"},
        "max_episode_steps": 25,
    }
    taken = EnvironmentConfig(id=ODD.format("Table"), dynamics=dynamics).dynamics
    assert taken == dynamics | {"options": {"deep": [{"er": "1.5.2"}], "small": 2e-4}}
    assert type(taken["substeps"]) is int
    spec = check_environment(ODD.format("Table"), taken)
    assert (spec.max_episode_steps, spec.observation_shape) == (25, (2, 3))
    held: Any = gymnasium.make(ODD.format("Table"), **taken).unwrapped
    assert held.arguments["options"]["small"] == 2e-4


def test_dynamics_of_ours_are_numbers() -> None:
    ours = "oodil/Panda-v0"
    taken = EnvironmentConfig(id=ours, dynamics={"spread": 1, "frame_skip": 6, "joint_1": "1e0"}).dynamics
    assert taken == {"spread": 1.0, "frame_skip": 6, "joint_1": 1.0}
    assert [type(value) for value in taken.values()] == [float, int, float]
    for wrong in ("low", [1.0], None, {"a": 1}):
        with pytest.raises(ValueError, match="spread has to be a number in an environment of ours"):
            EnvironmentConfig(id=ours, dynamics={"spread": wrong})
