"""The driving world in its batched form against highway-env's own classes, over random worlds, drivers and episodes."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

from oodil.pipeline.environments import make_batch
from oodil.pipeline.environments.driving import DrivingBatch, DrivingEnv
from oodil.pipeline.environments.driving_world import GOAL, layout, observe, touches
from oodil.pipeline.errors import OodilError
from oodil.pipeline.evaluation import run_episodes
from oodil.pipeline.seeding import numpy_rng
from oodil.pipeline.stages.demonstrations import hand_written

ID = "oodil/Driving-v0"
SHARES = st.floats(0.05, 0.45)
SOURCES = {
    "target": {"obstacle_1": 0.4, "obstacle_2": 0.25, "speed": 1.0},
    "wide first obstacle": {"obstacle_1": 0.5, "obstacle_2": 0.25, "speed": 1.0},
    "wide second obstacle": {"obstacle_1": 0.1, "obstacle_2": 0.5, "speed": 1.0},
    "fast": {"obstacle_1": 0.25, "obstacle_2": 0.25, "speed": 5.0},
}


@settings(max_examples=25)
@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(0, 6.28), st.floats(-1, 1))
def test_a_placed_car_goes_on_as_the_original(east: float, north: float, heading: float, steering: float) -> None:
    """To the precision of the observation, 32 bits; the other cars of the batch do not notice."""
    batch, other, third = (make_batch(ID, {}, 2) for _ in range(3))
    for g in range(2):
        other.reset(g, g)
    untouched = other.snapshot()
    seen = np.array([east, north, np.cos(heading), np.sin(heading), heading], np.float32)
    batch.place(0, seen)
    observed = [*seen[:4], heading - 2 * np.pi * (heading >= 1.5 * np.pi)]  # the same angle, from where it is counted
    np.testing.assert_allclose(batch.observations()[0], observed, atol=1e-6)
    batch.step(np.full((2, 1), steering))
    other.step(np.zeros((2, 1)))
    other.restore(untouched)
    other.place(0, batch.observations()[0].astype(np.float32))
    snapshot = other.snapshot()
    assert snapshot.elapsed_steps[0] == snapshot.episode_returns[0] == 0
    assert snapshot.states[1].tobytes() == untouched.states[1].tobytes()
    third.restore(snapshot)
    for cars in (batch, other, third):
        cars.step(np.full((2, 1), -steering))
    apart = np.abs(other.observations()[0] - batch.observations()[0])
    assert np.minimum(apart, np.abs(apart - 2 * np.pi)).max() < 1e-6
    assert third.observations().tobytes() == other.observations().tobytes()


@pytest.mark.slow
@settings(max_examples=25)
@given(SHARES, SHARES, st.floats(0.5, 8.0), st.integers(0, 2**31 - 1))
def test_the_batch_drives_as_highway_env_does(first: float, second: float, speed: float, seed: int) -> None:
    """The same starts and steering: the same observations, rewards and ends, whatever is hit."""
    dynamics = {"obstacle_1": first, "obstacle_2": second, "speed": speed}
    batch = make_batch(ID, dynamics, 4)
    assert isinstance(batch, DrivingBatch)
    rng = np.random.default_rng(seed)
    envs = [gymnasium.make(ID, **dynamics) for _ in range(4)]
    for g, env in enumerate(envs):
        batch.reset(g, seed + g)
        observation, _ = env.reset(seed=seed + g)
        np.testing.assert_array_equal(batch.observations()[g], observation)
    # Steering that wanders, so that cars turn round, hit the sides of obstacles and leave on all sides.
    steering = np.clip(np.cumsum(rng.normal(0, 0.2, (400, 4)), axis=0), -1, 1)
    running = set(range(4))
    for actions in steering:
        outcome = batch.step(actions[:, None])
        for g in sorted(running):
            observation, reward, terminated, _, _ = envs[g].step(actions[g : g + 1].astype(np.float64))
            np.testing.assert_allclose(batch.observations()[g], observation, atol=1e-9)
            assert (outcome.env_rewards[g], outcome.terminated[g]) == (reward, terminated)
            if terminated:
                running.remove(g)
        if not running:
            break


@given(st.floats(0, 60), st.floats(0, 50), st.floats(0, 2 * np.pi), st.sampled_from([0.1, 0.25, 0.5]), st.booleans())
def test_cars_touch_what_they_touch_in_highway_env(
    x: float, y: float, heading: float, share: float, is_goal: bool
) -> None:
    env = DrivingEnv(share, share, 1.0)
    env.reset(seed=0)
    env._car.position, env._car.heading = np.array([x, y]), heading
    thing = env._goal if is_goal else env._obstacles[1]
    env._car.handle_collisions(thing)
    box = GOAL if is_goal else layout(share, share, 1.0).obstacles[1]
    touched = touches(np.array([x]), np.array([y]), np.array([heading]), box)[0]
    assert touched == (thing.hit if is_goal else env._car.crashed)


def test_gymnasium_finds_nothing_to_complain_about() -> None:
    check_env(gymnasium.make(ID, render_mode="rgb_array").unwrapped)


def test_a_snapshot_continues_to_the_same_bits() -> None:
    batch, other = make_batch(ID, {}, 3), make_batch(ID, {}, 3)
    for g in range(3):
        batch.reset(g, g)
    actions = np.random.default_rng(0).uniform(-1, 1, (60, 3, 1)).astype(np.float32)
    for action in actions[:30]:
        batch.step(action)
    other.restore(batch.snapshot())
    for action in actions[30:]:
        one, two = batch.step(action), other.step(action)
        assert one.env_rewards.tobytes() == two.env_rewards.tobytes()
    assert batch.snapshot().states.tobytes() == other.snapshot().states.tobytes()
    assert batch.episode_returns().tobytes() == other.episode_returns().tobytes()


@pytest.mark.parametrize("steering", [0.3, -0.3])
def test_the_heading_jumps_opposite_to_straight_ahead_alone(steering: float) -> None:
    """A car that turns round once: its angle is that of its velocity, without a jump but at 3 pi / 2."""
    batch = make_batch(ID, {}, 1)
    batch.reset(0, 0)
    start = batch.snapshot()
    batch.restore(replace(start, states=np.array([[30.0, 12.0, np.pi / 2]])))
    seen = [batch.observations()[0]]
    while not len(seen) > 3 or abs(np.unwrap([row[4] for row in seen])[-1] - np.pi / 2) < 2 * np.pi:
        batch.step(np.array([[steering]]))
        seen.append(batch.observations()[0])
    states = np.array(seen)
    heading = states[:, 4]
    assert (heading >= -np.pi / 2).all() and (heading < 1.5 * np.pi).all()
    np.testing.assert_allclose(np.exp(1j * heading), states[:, 2] + 1j * states[:, 3], atol=1e-12)
    (jump,) = np.flatnonzero(np.abs(np.diff(heading)) > 0.1)
    np.testing.assert_allclose(states[jump : jump + 2, 3], -1, atol=0.01)  # it drives straight back


@given(st.floats(-50, 50))
def test_an_observed_heading_is_its_own_observation(heading: float) -> None:
    """A car put where it was seen is seen there again, to the bit."""
    here = np.array([0.0])
    seen = observe(here, here, np.array([heading]), 1.0)
    again = observe(here, here, seen[:, 4], 1.0)[:, 4]
    assert again.tobytes() == seen[:, 4].tobytes() or abs(again[0] - seen[0, 4]) == 2 * np.pi
    np.testing.assert_allclose(np.exp(1j * seen[0, 4]), np.exp(1j * heading), atol=1e-13)


@given(st.floats(1, 59), st.floats(1, 49), st.floats(-1.5, 4.7), st.floats(-1, 1), st.sampled_from(sorted(SOURCES)))
def test_a_placed_car_is_seen_there_and_goes_on_as_the_recorded_one(
    x: float, y: float, heading: float, steering: float, name: str
) -> None:
    cars, action = make_batch(ID, SOURCES[name], 2), np.full((2, 1), steering)
    speed = SOURCES[name]["speed"]
    seen = observe(np.array(x), np.array(y), np.array(heading), speed).astype(np.float32)
    cars.place(0, seen)
    np.testing.assert_allclose(cars.observations()[0], seen, atol=1e-6 * max(1, speed))
    cars.step(action)
    recorded = cars.observations()[0]
    cars.place(1, seen)
    cars.step(action)
    assert cars.observations()[1].tobytes() == recorded.tobytes()
    turned = heading + speed * 0.1 * np.sin(np.arctan(0.5 * np.tan(steering)))
    np.testing.assert_allclose(np.exp(1j * recorded[4]), np.exp(1j * turned), atol=1e-5)


@pytest.mark.parametrize("name", SOURCES)
def test_no_demonstrator_drives_near_the_jump(name: str) -> None:
    cars = make_batch(ID, SOURCES[name], 60)
    episodes = run_episodes(cars, hand_written(cars, ID), numpy_rng((1,)), stochastic=False)
    headings = np.concatenate([episode.states[:, 4] for episode in episodes])
    assert headings.min() > 0 and headings.max() < np.pi


@pytest.mark.parametrize("name", SOURCES)
def test_the_driver_reaches_the_goal_in_its_own_world(name: str) -> None:
    cars = make_batch(ID, SOURCES[name], 60)
    episodes = run_episodes(cars, hand_written(cars, ID), numpy_rng((0,)), stochastic=False)
    assert all(episode.env_return > -500 for episode in episodes), "the goal was not reached"
    speeds = {round(float(np.hypot(*episode.states[-1][2:4])), 4) for episode in episodes}
    assert speeds == {SOURCES[name]["speed"]}


@pytest.mark.parametrize(
    ("dynamics", "message"),
    [({"obstacle_1": 1.2}, "obstacle_1 is 1.2"), ({"speed": 0.0}, "speed is 0.0"), ({"gravity": 1.0}, "gravity")],
)
def test_a_world_that_cannot_be_is_refused(dynamics: dict[str, float], message: str) -> None:
    with pytest.raises(OodilError, match=message):
        make_batch(ID, dynamics, 1)
