"""The batched simulators against Gymnasium, step by step and to the bit; snapshots; dynamics that really change."""

import copy
import pickle
import time

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from oodil.pipeline.environments import environment_spec, make_batch
from oodil.pipeline.errors import OodilError

HOPPER, WALKER, CHEETAH = "oodil/Hopper-v0", "oodil/Walker2d-v0", "oodil/HalfCheetah-v0"
FOREVER = {"terminate_when_unhealthy": False}
"""With this episodes go on when the robot has fallen."""


def set_gravity(model):
    model.opt.gravity[2] = -12.0


def set_friction(model):
    model.geom("foot_geom").friction[0] = 3.9
    model.geom("foot_left_geom").friction[0] = 3.9


def set_gears(model):
    for name in ("fthigh", "fshin", "ffoot"):
        model.actuator(name).gear[0] *= 0.05
    for name in ("bthigh", "bshin", "bfoot"):
        model.actuator(name).gear[0] *= 0.9


SAME_DYNAMICS = [
    (HOPPER, "Hopper-v5", {}, None),
    (HOPPER, "Hopper-v5", {"gravity": 12.0}, set_gravity),
    (WALKER, "Walker2d-v5", {}, None),
    (WALKER, "Walker2d-v5", {"friction": 3.9}, set_friction),
    (CHEETAH, "HalfCheetah-v5", {}, None),
    (CHEETAH, "HalfCheetah-v5", {"front": 0.05, "back": 0.9}, set_gears),
]


def gymnasium_env(base, change, **kwargs):
    env = gymnasium.make(base, exclude_current_positions_from_observation=False, **kwargs)
    if change:
        change(env.unwrapped.model)
    return env


def assert_equal_steps(batch, envs, num_steps, actions):
    """Step both sides together and reset ended simulators by the same seeds; return how many episodes ended how."""
    for g, env in enumerate(envs):
        batch.reset(g, seed=g)
        np.testing.assert_array_equal(batch.observations()[g], env.reset(seed=g)[0])
    terminations = truncations = 0
    returns = np.zeros(len(envs))
    lengths = np.zeros(len(envs), int)
    for t in range(num_steps):
        action = actions(t)
        outcome, observations = batch.step(action), batch.observations()
        lengths += 1
        for g, env in enumerate(envs):
            expected, reward, terminated, truncated, _ = env.step(action[g])
            assert observations[g].tobytes() == expected.tobytes(), (t, g)
            assert (outcome.env_rewards[g], outcome.terminated[g], outcome.truncated[g]) == (
                reward,
                terminated,
                truncated,
            ), (t, g)
            returns[g] += reward
            assert batch.episode_returns()[g] == returns[g]
            assert batch.elapsed_steps()[g] == lengths[g]
            if terminated or truncated:
                terminations += terminated
                truncations += truncated
                seed = 1000 + len(envs) * t + g
                expected, _ = env.reset(seed=seed)
                batch.reset(g, seed=seed)
                assert batch.observations()[g].tobytes() == expected.tobytes()
                returns[g] = lengths[g] = 0
    return terminations, truncations


def random_actions(batch, size=1.0, dtype=np.float32):
    """A little beyond the range of the actuators, so that both sides have to clip alike."""
    rng = np.random.default_rng(0)
    return lambda t: rng.uniform(-1.3 * size, 1.3 * size, (batch.num_simulators, batch.action_dim)).astype(dtype)


@pytest.mark.parametrize(("env_id", "base", "dynamics", "change"), SAME_DYNAMICS)
def test_batch_equals_gymnasium(env_id, base, dynamics, change):
    batch = make_batch(env_id, dynamics, 4)
    envs = [gymnasium_env(base, change) for _ in range(4)]
    num_steps = 1050 if base == "HalfCheetah-v5" else 300
    terminations, truncations = assert_equal_steps(batch, envs, num_steps, random_actions(batch))
    if base == "HalfCheetah-v5":
        assert (terminations, truncations) == (0, 4)
    else:
        assert terminations > 20


@pytest.mark.parametrize(("env_id", "base", "dynamics", "change"), [SAME_DYNAMICS[0], SAME_DYNAMICS[2]])
def test_batch_equals_gymnasium_at_the_time_limit(env_id, base, dynamics, change):
    """Episodes that may go on when the robot has fallen last to the limit and are truncated there."""
    batch = make_batch(env_id, dynamics | FOREVER, 2)
    envs = [gymnasium_env(base, change, **FOREVER) for _ in range(2)]
    assert assert_equal_steps(batch, envs, 1010, random_actions(batch, 0.2)) == (0, 2)


def test_batch_equals_gymnasium_with_double_precision_actions():
    batch = make_batch(HOPPER, {}, 2)
    assert_equal_steps(batch, [gymnasium_env("Hopper-v5", None) for _ in range(2)], 60, random_actions(batch, 1, float))


@pytest.mark.parametrize(("env_id", "base", "dynamics", "change"), SAME_DYNAMICS[1::2])
def test_registered_environment_equals_gymnasium(env_id, base, dynamics, change):
    ours, theirs = gymnasium.make(env_id, **dynamics), gymnasium_env(base, change)
    rng = np.random.default_rng(0)
    assert ours.observation_space.shape == theirs.observation_space.shape
    assert ours.spec.max_episode_steps == theirs.spec.max_episode_steps == 1000
    for episode in range(5):
        np.testing.assert_array_equal(ours.reset(seed=episode)[0], theirs.reset(seed=episode)[0])
        for _ in range(60):
            action = rng.uniform(-1, 1, ours.action_space.shape).astype(np.float32)
            one, two = ours.step(action), theirs.step(action)
            assert one[0].tobytes() == two[0].tobytes()
            assert one[1:4] == two[1:4]
            if one[2]:
                break


@pytest.mark.parametrize("env_id", [HOPPER, WALKER, CHEETAH])
@pytest.mark.filterwarnings("ignore:.*A Box observation space.*")
def test_gymnasium_checker_passes(env_id):
    check_env(gymnasium.make(env_id).unwrapped, skip_render_check=True)


@pytest.mark.parametrize(
    ("env_id", "dynamics", "size"),
    [(HOPPER, {}, 1.0), (HOPPER, FOREVER, 0.3), (WALKER, FOREVER, 0.3), (CHEETAH, {}, 1.0), (CHEETAH, {}, 0.1)],
)
def test_a_snapshot_continues_to_the_same_bits(env_id, dynamics, size, assert_same_bits):
    """A robot that lies about shows whether the solver's warm start is part of the snapshot."""
    batch = make_batch(env_id, dynamics, 3)
    actions = random_actions(batch, size)
    plan = [actions(t) for t in range(450)]

    def play(simulators, first, last):
        history = []
        for t in range(first, last):
            outcome = simulators.step(plan[t])
            history.append(
                (simulators.observations(), outcome, simulators.elapsed_steps(), simulators.episode_returns())
            )
            for g in np.flatnonzero(outcome.terminated | outcome.truncated):
                simulators.reset(int(g), seed=3 * t + int(g))
        return history

    for g in range(3):
        batch.reset(g, seed=g)
    play(batch, 0, 150)
    assert batch.elapsed_steps().any(), "the snapshot is to lie within an episode"
    snapshot = batch.snapshot()
    kept = snapshot.states.copy()
    expected = play(batch, 150, 450)
    batch.restore(snapshot)
    assert_same_bits(play(batch, 150, 450), expected)
    other = make_batch(env_id, dynamics, 3)
    for g in range(3):
        other.reset(g, seed=77)
    other.restore(snapshot)
    assert_same_bits(play(other, 150, 450), expected)
    np.testing.assert_array_equal(snapshot.states, kept)


@pytest.mark.parametrize("taken_from", [2, 4])
def test_a_snapshot_of_another_size_is_refused(taken_from):
    with pytest.raises(ValueError, match="snapshot"):
        make_batch(HOPPER, {}, 3).restore(make_batch(HOPPER, {}, taken_from).snapshot())


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize(
    ("env_id", "dynamics"),
    [(HOPPER, {"gravity": 7.0}), (WALKER, {"friction": 3.0}), (CHEETAH, {"front": 0.5, "back": 0.9})],
)
def test_an_environment_can_be_copied_with_its_dynamics(env_id, dynamics, copied):
    env, plain = gymnasium.make(env_id, **dynamics).unwrapped, gymnasium.make(env_id).unwrapped
    other = copied(env)

    def physics(task):
        return np.concatenate([part.ravel() for part in task_parts(task.model)])

    assert np.array_equal(physics(other), physics(env)) and not np.array_equal(physics(other), physics(plain))
    assert other.observation_space == env.observation_space


def task_parts(model):
    """Return what dynamics change in a model."""
    return model.opt.gravity, model.geom_friction, model.geom_priority, model.actuator_gear


def test_a_snapshot_of_another_model_is_refused():
    with pytest.raises(ValueError, match="snapshot"):
        make_batch(HOPPER, {}, 3).restore(make_batch(WALKER, {}, 3).snapshot())


def test_a_simulator_does_not_depend_on_its_neighbors():
    one, two = make_batch(HOPPER, {}, 2), make_batch(HOPPER, {}, 2)
    rng = np.random.default_rng(0)
    for batch, seed in ((one, 1), (two, 2)):
        batch.reset(0, seed=seed)
        batch.reset(1, seed=9)
    for _ in range(50):
        action = rng.uniform(-1, 1, (2, 3))
        one.step(action)
        two.step(action)
    assert one.observations()[1].tobytes() == two.observations()[1].tobytes()
    assert one.observations()[0].tobytes() != two.observations()[0].tobytes()


def placed_beside(batch, other, steps):
    """Move along with random actions and place the first simulator's observation in the other batch before each.

    Returns (steps, 2) how far one step from there is from one step of the original, and whether no velocity is clipped.
    """
    rng, seen = np.random.default_rng(0), []
    for t in range(steps):
        observation = batch.observations()[0].astype(np.float32)
        other.place(0, observation)
        assert (other.observations()[0] == observation).all()
        told = batch.tells_state(batch.observations())[0]
        actions = np.repeat(rng.uniform(-0.5, 0.5, (1, batch.action_dim)), 2, axis=0)
        outcome = batch.step(actions)
        other.step(actions)
        seen.append((np.abs(batch.observations()[0] - other.observations()[0]).max(), told))
        if outcome.terminated[0]:
            batch.reset(0, seed=t)
    return np.array(seen)


@pytest.mark.parametrize(
    ("env_id", "dynamics", "tolerance"),
    [(HOPPER, {"gravity": 12.0}, 3e-5), (WALKER, {"friction": 19.9}, 3e-5), (CHEETAH, {"back": 0.9}, 3e-4)],
)
def test_a_placed_robot_goes_on_as_the_original(env_id, dynamics, tolerance):
    """To the precision of the observation, 32 bits, wherever no velocity is clipped."""
    batch, other = make_batch(env_id, dynamics, 2), make_batch(env_id, dynamics, 2)
    batch.reset(0, seed=0)
    errors, told = placed_beside(batch, other, 300).T
    errors = errors[told == 1]
    assert len(errors) > 100
    assert np.median(errors) < 3e-6 and errors.max() < tolerance


def test_clipped_velocities_do_not_tell_the_state():
    batch = make_batch(WALKER, {}, 1)
    seen = np.zeros((3, 18))
    seen[0, 9:], seen[1, 12], seen[2, :9] = 9.9, -10.0, 50.0
    assert batch.tells_state(seen).tolist() == [True, False, True]
    assert make_batch(CHEETAH, {}, 1).tells_state(seen).all()


def test_placing_starts_an_episode_and_leaves_the_others_alone(assert_same_bits):
    """Nothing of what was before matters, the solver's warm start included."""
    batch, fresh = make_batch(WALKER, FOREVER, 3), make_batch(WALKER, FOREVER, 3)
    actions = random_actions(batch)
    for g in range(3):
        batch.reset(g, seed=g)
        fresh.reset(g, seed=g + 9)
    for t in range(100):
        batch.step(actions(t))
    before, observation = batch.snapshot(), batch.observations()[0].astype(np.float32)
    batch.place(1, observation)
    fresh.place(1, observation)
    after = batch.snapshot()
    for name in ("states", "elapsed_steps", "episode_returns"):
        assert_same_bits(getattr(after, name)[[0, 2]], getattr(before, name)[[0, 2]])
        assert_same_bits(getattr(after, name)[1], getattr(fresh.snapshot(), name)[1])
    assert (after.elapsed_steps[1], after.episode_returns[1]) == (0, 0)
    other = make_batch(WALKER, FOREVER, 3)
    other.restore(after)
    for t in range(50):
        action = actions(t)
        assert_same_bits(batch.step(action), other.step(action))
        assert_same_bits(batch.observations(), other.observations())


@pytest.mark.parametrize(("env_id", "placeable"), [(HOPPER, True), ("oodil/Driving-v0", True), ("Pendulum-v1", False)])
def test_whether_an_environment_can_be_placed_is_known_before(env_id, placeable):
    assert environment_spec(env_id, {}).can_be_placed == placeable


@pytest.mark.parametrize("gravity", [1.0, 9.81, 15.0])
def test_gravity_accelerates_a_hopper_in_the_air(gravity):
    env = gymnasium.make(HOPPER, gravity=gravity).unwrapped
    env.reset(seed=0)
    env.data.qpos[1] = 5.0

    def fall():
        mujoco.mj_forward(env.model, env.data)
        mujoco.mj_subtreeVel(env.model, env.data)
        return env.data.subtree_linvel[0, 2]

    before = fall()
    env.do_simulation(np.zeros(3), 50)
    elapsed = 50 * env.model.opt.timestep
    assert (fall() - before) / elapsed == pytest.approx(-gravity, rel=1e-3)


def foot_friction(friction):
    """Sliding friction in an actual contact of a foot with the floor."""
    env = gymnasium.make(WALKER, friction=friction).unwrapped
    env.reset(seed=0)
    for _ in range(100):
        env.step(np.zeros(6))
        for contact in env.data.contact:
            names = {env.model.geom(int(geom)).name for geom in contact.geom}
            if names & {"foot_geom", "foot_left_geom"} and "floor" in names:
                return contact.friction[0]
    raise AssertionError("no foot touched the floor")


@pytest.mark.parametrize("friction", [24.8, 1.1, 0.7, 0.1])
def test_the_feet_decide_on_the_friction_of_their_contacts(friction):
    """Where the feet's is the larger one, MuJoCo's own rule gives the same: see the comparison with Gymnasium above."""
    assert foot_friction(friction) == pytest.approx(friction)


def test_motors_of_the_cheetah_scale_by_leg():
    def forces(**scales):
        env = gymnasium.make(CHEETAH, **scales).unwrapped
        env.reset(seed=0)
        env.data.ctrl[:] = 1.0
        mujoco.mj_forward(env.model, env.data)
        names = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
        return np.array([env.data.qfrc_actuator[env.model.joint(name).dofadr[0]] for name in names])

    full = forces()
    np.testing.assert_allclose(full, [120, 90, 60, 120, 60, 30])
    np.testing.assert_allclose(forces(front=0.05), full * [1, 1, 1, 0.05, 0.05, 0.05])
    np.testing.assert_allclose(forces(back=0.5, front=0.9), full * [0.5, 0.5, 0.5, 0.9, 0.9, 0.9])


def test_one_environments_dynamics_do_not_leak_into_another():
    heavy, plain = gymnasium.make(HOPPER, gravity=15.0), gymnasium.make(HOPPER)
    assert heavy.unwrapped.model.opt.gravity[2] == -15.0
    assert plain.unwrapped.model.opt.gravity[2] == -9.81


@pytest.mark.parametrize(
    ("env_id", "dynamics", "message"),
    [
        ("oodil/Hoper-v0", {}, "oodil/Hoper-v0"),
        ("CartPole-v1", {}, r"the action space is Discrete\(2\); only Box"),
        ("nowhere_at_all:Env-v0", {}, "No module named 'nowhere_at_all'"),
        (HOPPER, {"gravity": 0.0}, "gravity is 0.0"),
        (HOPPER, {"gravity": float("nan")}, "gravity is nan"),
        (HOPPER, {"gravity": float("inf")}, "gravity is inf"),
        (WALKER, {"friction": -1.0}, "friction is -1.0"),
        (CHEETAH, {"front": -0.1}, "front and back are -0.1"),
        (CHEETAH, {"back": float("nan")}, "front and back are 1.0 and nan"),
        (HOPPER, {"friction": 1.0}, "does not take the dynamics.*friction"),
    ],
)
def test_bad_environments_are_refused(env_id, dynamics, message):
    with pytest.raises(OodilError, match=message):
        make_batch(env_id, dynamics, 1)


def test_mujoco_does_not_time_itself():
    """Without `make_batch` it does: a new simulator brings a clock."""
    before = mujoco.get_mjcb_time()
    durations = []
    try:
        mujoco.set_mjcb_time(None)
        model = mujoco.MjModel.from_xml_string("<mujoco/>")
        data = mujoco.MjData(model)
        for _ in range(2):
            mujoco.mj_resetData(model, data)
            mujoco.mj_step(model, data, 100)
            durations.append(data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration)
            make_batch("oodil/Hopper-v0", {}, 1)
    finally:
        mujoco.set_mjcb_time(before)
    assert durations[0] > 0 and durations[1] == 0


def test_a_clock_that_somebody_has_set_stays():
    """MuJoCo's clock belongs to the whole process; a batch stops it only if it is MuJoCo's own."""
    before = mujoco.get_mjcb_time()
    try:
        mujoco.set_mjcb_time(time.perf_counter)
        make_batch("oodil/Hopper-v0", {}, 1)
        assert mujoco.get_mjcb_time() is time.perf_counter
    finally:
        mujoco.set_mjcb_time(before)
