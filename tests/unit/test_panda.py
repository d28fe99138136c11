"""The arm: batch and Gymnasium form agree, locked joints do not move, demonstrators reach the goal."""

from functools import lru_cache

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from oodil.pipeline.data import Episode
from oodil.pipeline.environments import make_batch
from oodil.pipeline.environments.panda import judge
from oodil.pipeline.environments.panda_arm import ALL_JOINTS, Arm, start_angles
from oodil.pipeline.errors import OodilError
from oodil.pipeline.evaluation import run_episodes
from oodil.pipeline.seeding import numpy_rng
from oodil.pipeline.stages.demonstrations import hand_written

ID, SLOW_ID = "oodil/Panda-v0", "oodil/Panda20Hz-v0"
ARMS = {"whole": (), "1": (1,), "3": (3,), "4": (4,), "6": (6,), "1, 3": (1, 3), "1, 3, 4": (1, 3, 4)}


def dynamics(locked: tuple[int, ...], spread: float = 0.2) -> dict[str, float]:
    return {f"joint_{number}": 0.0 for number in locked} | {"spread": spread}


@lru_cache
def demonstrated(locked: tuple[int, ...], env_id: str = ID) -> list[Episode]:
    arms = make_batch(env_id, dynamics(locked), 6)
    return run_episodes(arms, hand_written(arms, env_id), numpy_rng((0,)), stochastic=False)


@pytest.mark.parametrize("env_id", [ID, SLOW_ID])
def test_gymnasium_checker_passes(env_id: str) -> None:
    check_env(gymnasium.make(env_id, joint_1=0).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("locked", ARMS.values(), ids=ARMS)
def test_batch_equals_gymnasium(locked: tuple[int, ...]) -> None:
    """To the last bit, through a reset in the middle."""
    batch = make_batch(ID, dynamics(locked), 3)
    envs = [gymnasium.make(ID, disable_env_checker=True, **dynamics(locked)) for _ in range(3)]
    rng = np.random.default_rng(0)
    for seed in (3, 4):
        first = []
        for g, env in enumerate(envs):
            batch.reset(g, seed + g)
            first.append(env.reset(seed=seed + g)[0])
        assert batch.observations().tobytes() == np.stack(first).tobytes()
        for _ in range(200):
            actions = rng.uniform(-1.5, 1.5, (3, batch.action_dim)).astype(np.float32)
            outcome = batch.step(actions)
            stepped = [env.step(action) for env, action in zip(envs, actions, strict=True)]
            assert batch.observations().tobytes() == np.stack([s[0] for s in stepped]).tobytes()
            assert outcome.env_rewards.tolist() == [s[1] for s in stepped]
            assert outcome.terminated.tolist() == [s[2] for s in stepped]


def test_a_slower_control_step_is_many_under_one_action() -> None:
    fast, slow = make_batch(ID, dynamics((1, 3)), 2), make_batch(SLOW_ID, dynamics((1, 3)), 2)
    for g in range(2):
        fast.reset(g, g)
        slow.reset(g, g)
    for actions in np.random.default_rng(0).uniform(-1, 1, (20, 2, 4)):
        for _ in range(12):
            fast.step(actions)
        slow.step(actions)
        assert slow.observations().tobytes() == fast.observations().tobytes()


def test_a_snapshot_continues_to_the_same_bits(assert_same_bits) -> None:
    """Also in another batch, and with the hand on the box."""
    batch, other = (make_batch(ID, dynamics((1, 3)), 2) for _ in range(2))
    pusher = hand_written(batch, ID)
    for g in range(2):
        batch.reset(g, g)
    for _ in range(400):
        batch.step(pusher.mean(batch.observations()))
    assert (batch.observations()[:, 3] > 0.51).all(), "the box was not touched"
    other.restore(batch.snapshot())
    actions = np.random.default_rng(0).uniform(-1, 1, (50, 2, 4))
    trace = [[(b.step(a), b.observations()) for a in actions] for b in (batch, other)]
    assert_same_bits(*trace)
    assert_same_bits(batch.snapshot(), other.snapshot())


@pytest.mark.parametrize("locked", [(), (1, 3), (1, 3, 4)], ids=str)
def test_a_placed_arm_has_hand_and_box_where_they_were(locked: tuple[int, ...], assert_same_bits) -> None:
    """Within 1 mm; after a step within 15 mm, since it starts at rest."""
    batch, other, third = (make_batch(SLOW_ID, dynamics(locked), 2) for _ in range(3))
    pusher = hand_written(batch, SLOW_ID)
    for g in range(2):
        batch.reset(g, g)
        other.reset(g, g)
    untouched = other.snapshot()
    for t in range(60):
        seen = batch.observations()
        actions = pusher.mean(seen)
        batch.step(actions)
        if t % 12:
            continue
        other.place(0, seen[0].astype(np.float32))
        np.testing.assert_allclose(other.observations()[0], seen[0], atol=1e-3)
        after = other.snapshot()
        assert after.elapsed_steps[0] == after.episode_returns[0] == 0
        assert_same_bits(after.states[1], untouched.states[1])
        third.restore(after)
        other.step(actions)
        third.step(actions)
        assert_same_bits(other.snapshot(), third.snapshot())
        np.testing.assert_allclose(other.observations()[0], batch.observations()[0], atol=0.015)
        other.restore(untouched)
    assert not batch.tells_state(batch.observations()).any()


def relative_turn(arm: Arm, data: mujoco.MjData, number: int) -> np.ndarray:
    """Return the rotation of a joint's link against the link before."""
    child = arm.model.body(f"robot0_link{number}")
    turn = np.empty(3)
    mujoco.mju_subQuat(turn, data.xquat[child.id], data.xquat[child.parentid[0]])
    return turn


@pytest.mark.parametrize("locked", [(1, 3), (3,), (4,), (6,)])
def test_locked_joints_stay_where_they_are(locked: tuple[int, ...]) -> None:
    arm = Arm(tuple(number for number in ALL_JOINTS if number not in locked), 0.2, 1)
    data = mujoco.MjData(arm.model)
    arm.start(data, np.random.default_rng(0))
    before = {number: relative_turn(arm, data, number) for number in range(1, 8)}
    rng = np.random.default_rng(1)
    for _ in range(1000):
        arm.move(data, rng.uniform(-1, 1, len(arm.working)) + 0.5)
    moved = {number: np.abs(relative_turn(arm, data, number) - before[number]).max() for number in before}
    assert all(moved[number] < 1e-3 for number in (*locked, 7))
    assert all(moved[number] > 0.05 for number in arm.working)


@pytest.mark.parametrize("working", [(2, 4, 5), (2, 5)])
def test_locked_links_are_where_the_joints_would_hold_them(working: tuple[int, ...]) -> None:
    angles = start_angles(working)
    hands = []
    for arm in (Arm(ALL_JOINTS, 0.0, 1), Arm(working, 0.0, 1)):
        data = mujoco.MjData(arm.model)
        data.qpos[arm.angles] = [angles[number] for number in arm.working]
        mujoco.mj_kinematics(arm.model, data)
        hands.append(arm.hand(data))
    np.testing.assert_allclose(*hands, atol=1e-9)


def test_the_servo_turns_a_joint_by_its_distance_to_the_wanted_angle() -> None:
    """Unit gain: of a step of the wanted angle, 1 - 1/e is done after one second."""
    arm = Arm((2, 4, 5, 6), 0.0, 1)
    data = mujoco.MjData(arm.model)
    arm.start(data, np.random.default_rng(0))
    begin = data.qpos[arm.angles].copy()
    step = np.array([-0.1, 0.1, 0.1, -0.1])
    data.ctrl[:] = begin + step
    for _ in range(240):
        arm.move(data, np.zeros(4))
    done = (data.qpos[arm.angles] - begin) / step
    np.testing.assert_allclose(done, 1 - np.exp(-1), rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", [ID, SLOW_ID])
@pytest.mark.parametrize("locked", ARMS.values(), ids=ARMS)
def test_the_demonstrator_pushes_the_box_to_the_goal(locked: tuple[int, ...], env_id: str) -> None:
    assert sum(episode.env_return > 900 for episode in demonstrated(locked, env_id)) >= 5


@pytest.mark.slow
def test_two_joints_are_not_enough() -> None:
    """With joints 2 and 5 alone, an arm pushes the box a few centimetres and then lifts its hand over it."""
    assert max(episode.states[:, 3].max() for episode in demonstrated((1, 3, 4, 6))) < 0.6


@pytest.mark.slow
@pytest.mark.parametrize(("locked", "is_low"), [((1, 3), True), ((1, 3, 4), False)])
def test_a_locked_elbow_keeps_the_hand_above_the_middle_of_the_box(locked: tuple[int, ...], is_low: bool) -> None:
    """So it cannot follow those that push there."""
    for episode in demonstrated(locked):
        pushing = episode.states[episode.states[:, 3] > 0.55]
        assert (pushing[:, 2] < 0.13).all() == is_low


@pytest.mark.parametrize(
    ("hand_x", "box", "reward", "reached", "lost"),
    [
        (0.3, (0.5, 0.0, 0.08), 0.0, False, False),
        (0.6, (0.8, 0.4, 0.08), 1000.3, True, False),
        (0.9, (0.3, 0.0, 0.08), -1000.2, False, True),
        (0.6, (0.7, 0.0, -0.2), -999.8, False, True),
        (0.6, (0.7, -1.1, 0.08), -999.8, False, True),
    ],
)
def test_rewards_and_ends(hand_x: float, box: tuple[float, ...], reward: float, reached: bool, lost: bool) -> None:
    rewards, successes, failures = judge(np.array([[hand_x, 0.0, 0.1, *box]]))
    assert rewards[0] == pytest.approx(reward) and (successes[0], failures[0]) == (reached, lost)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"joint_1": 0.5}, "joint_1 is 0.5"),
        ({f"joint_{number}": 0 for number in ALL_JOINTS}, "every joint is locked"),
        ({"spread": -1.0}, "spread is -1.0"),
        ({"frame_skip": 0.5}, "frame_skip is 0.5"),
    ],
)
def test_bad_dynamics_are_refused(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(OodilError, match=message):
        make_batch(ID, wrong, 1)
