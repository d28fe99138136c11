"""Evaluation on the true return, which nothing ever learns from. Letters: E episodes, T states, S observation."""

import ctypes.util
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.collecting import begin
from oodil.pipeline.config import EnvironmentConfig
from oodil.pipeline.data import Episode
from oodil.pipeline.environments import Simulators, make_batch
from oodil.pipeline.errors import UnusableEnvironmentError
from oodil.pipeline.policy import Controller, GaussianPolicy
from oodil.pipeline.results import Evaluation, Policy
from oodil.pipeline.seeding import Key, derive_key, numpy_rng

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.gail import AdversarialReward

DISTANCE_EPISODES = 16
"""Mean-action episodes that a policy's distance to demonstrations is measured with."""
FRAMES_PER_SECOND = 30
"""Of a video, about; the environments run at 10 to 240 steps per second of simulated time."""


def run_episodes(
    simulators: Simulators,
    controller: Controller,
    rng: np.random.Generator,
    *,
    stochastic: bool,
    starts: NDArray[np.float32] | None = None,
) -> list[Episode]:
    """Run one fresh episode in every simulator side by side; only a Gaussian policy can be ``stochastic``.

    An episode begins as the environment has it begin, or in one of the (P, S) ``starts``.
    """
    count = simulators.num_simulators
    for g in range(count):
        begin(simulators, g, rng, starts)
    trace = [simulators.observations().astype(np.float32)]
    returns, lengths, terminated = np.zeros(count), np.zeros(count, np.int64), np.zeros(count, np.bool_)
    while not lengths.all():
        actions: NDArray[np.floating] = controller.mean(simulators.observations())
        if stochastic:
            assert isinstance(controller, GaussianPolicy)
            actions = actions + np.exp(controller.log_std) * rng.standard_normal(actions.shape, dtype=np.float32)
        outcome = simulators.step(actions)
        trace.append(simulators.observations().astype(np.float32))
        ended = (outcome.terminated | outcome.truncated) & (lengths == 0)
        lengths[ended] = simulators.elapsed_steps()[ended]
        returns[ended] = simulators.episode_returns()[ended]
        terminated[ended] = outcome.terminated[ended]
    states = np.stack(trace)
    return [Episode(states[: lengths[g] + 1, g], float(returns[g]), bool(terminated[g])) for g in range(count)]


def evaluate(
    policy: GaussianPolicy,
    env_id: str,
    dynamics: Mapping[str, Any],
    episodes: int,
    key: Key,
    *,
    stochastic: bool = False,
) -> Evaluation:
    """Run ``episodes`` fresh episodes, with mean actions unless ``stochastic``."""
    seen = run_episodes(make_batch(env_id, dynamics, episodes), policy, numpy_rng(key), stochastic=stochastic)
    return Evaluation(np.array([e.env_return for e in seen]), np.array([len(e.states) - 1 for e in seen]))


def distance_of(
    policy: GaussianPolicy,
    reward: "AdversarialReward",
    environment: EnvironmentConfig,
    seed: int,
    starts: NDArray[np.float32] | None = None,
) -> float:
    """Return how far fresh episodes of mean actions are from the demonstrations that a reward model was made for."""
    simulators = make_batch(environment.id, environment.dynamics, DISTANCE_EPISODES)
    rng = numpy_rng(derive_key(seed, "distance"))
    return reward.distance(run_episodes(simulators, policy, rng, stochastic=False, starts=starts))


def film(policy: Policy, env_id: str, dynamics: Mapping[str, Any], seed: int, path: Path) -> float:
    """Film one deterministic episode as MP4 and return its true return.

    Raises UnusableEnvironmentError when nothing can be rendered here, with what is missing.
    """
    import imageio.v3 as imageio

    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        # Gymnasium tries GLFW first, which only fails once it has to draw.
        os.environ.setdefault("MUJOCO_GL", "egl" if ctypes.util.find_library("EGL") else "osmesa")
    try:
        arguments: dict[str, Any] = {**dynamics, "render_mode": "rgb_array"}
        env = gymnasium.make(env_id, **arguments)
        observation, _ = env.reset(seed=seed)
        every = max(1, round(env.metadata["render_fps"] / FRAMES_PER_SECOND))
        frames: list[Any] = []
        env_return, ended, step = 0.0, False, 0
        while not ended:
            if step % every == 0:
                frames.append(env.render())
            observation, reward, terminated, truncated, _ = env.step(policy.act(np.asarray(observation)))
            env_return, ended, step = env_return + float(reward), terminated or truncated, step + 1
        fps = env.metadata["render_fps"] / every
        env.close()
        imageio.imwrite(path, np.stack(frames), fps=fps)
    except (ImportError, RuntimeError, AttributeError, mujoco.FatalError, gymnasium.error.Error) as error:
        raise UnusableEnvironmentError(
            f"cannot render here ({error}); a machine without a display needs EGL or OSMesa "
            "(Debian: apt-get install libegl1 or libosmesa6, then MUJOCO_GL=egl or MUJOCO_GL=osmesa)"
        ) from error
    return env_return
