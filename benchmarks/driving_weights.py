"""What a finished run of configs/driving.yaml made of every path: figures to judge it by. The report has the picture.

A demonstration can be reproduced if it drives at the imitator's speed and never touches the imitator's obstacles, which
is known exactly. Run ``python benchmarks/driving_weights.py RUN_DIR``; it prints the scores by source and by whether
the path is clear, and how many episodes of each policy reach the goal.

Letters: N demonstrations.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from common import one_thread
from numpy.typing import NDArray

import oodil
from oodil.pipeline.algorithms.weights import sampling_mass
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments import make_batch
from oodil.pipeline.environments.driving import STEP_REWARD, WIDTH, DrivingEnv, Layout, positions, touches
from oodil.pipeline.evaluation import run_episodes
from oodil.pipeline.results import Transferability
from oodil.pipeline.runs import RunResults, separation_metrics
from oodil.pipeline.seeding import derive_key, numpy_rng


def world_of(dynamics: Mapping[str, Any]) -> Layout:
    """Return the world that an environment with these dynamics has."""
    keywords: dict[str, Any] = dict(dynamics)
    return DrivingEnv(**keywords).layout


def is_clear(demonstrations: Demonstrations, world: Layout) -> NDArray[np.bool_]:
    """Return (N,) whether each demonstration drives where the world has no obstacle."""
    x, y = positions(demonstrations.observations).T
    heading = demonstrations.observations[:, 4].astype(np.float64)
    touched = np.any([touches(x, y, heading, box) for box in world.obstacles], axis=0)
    return ~np.logical_or.reduceat(touched, demonstrations.offsets[:-1])


def judge(results: RunResults, demonstrations: Demonstrations, world: Layout, found: Transferability) -> None:
    """Print what the scores make of paths that can be reproduced and of others."""
    sources = results.config.demonstrations.sources
    clear = is_clear(demonstrations, world)
    at_its_speed = np.array([world_of(source.dynamics).speed == world.speed for source in sources])
    reproducible = clear & at_its_speed[demonstrations.sources]
    scores, uniform = found.scores, np.ones(len(demonstrations))
    before, plain, after = (sampling_mass(each, demonstrations) for each in (uniform, scores, found.weights))

    def shares(some: NDArray[np.bool_]) -> str:
        return f"sampling mass {before[some].sum():.1%}, plain {plain[some].sum():.1%}, as used {after[some].sum():.1%}"

    for i, source in enumerate(sources):
        mine = demonstrations.sources == i
        for kind, some in (("clear", mine & clear), ("blocked", mine & ~clear)):
            if some.any():
                spread = f"{scores[some].mean():.3g} ({scores[some].min():.3g} to {scores[some].max():.3g})"
                print(f"{source.label}, {kind}: {some.sum()}, score {spread}, {shares(some)}")
    both = 0 < reproducible.sum() < len(reproducible)
    auroc = separation_metrics(reproducible, scores, found.weights, demonstrations)["auroc"] if both else np.nan
    print(f"reproducible: {reproducible.sum()} of {len(reproducible)}, AUROC {auroc:.3f}, {shares(reproducible)}")


def drive(results: RunResults, policy: str, num_episodes: int) -> str:
    """Return what a policy does in fresh episodes, also by the third of the start line that they begin in."""
    environment = results.config.environment
    cars = make_batch(environment.id, environment.dynamics, num_episodes)
    rng = numpy_rng(derive_key(results.config.seed, "benchmark"))
    episodes = run_episodes(cars, results.policy(policy).gaussian, rng, stochastic=False)
    returns = np.array([episode.env_return for episode in episodes])
    steps = np.array([len(episode.states) - 1 for episode in episodes])
    third = np.array([(episode.states[0, 0] / 2 + 0.5) * WIDTH // 25 for episode in episodes])
    reached = returns - STEP_REWARD * steps > 0
    parts = ", ".join(f"{reached[third == i].mean():.1%}" for i in range(3))
    return f"return {returns.mean():.0f}, {steps.mean():.0f} steps, reached the goal {reached.mean():.1%} ({parts})"


def main() -> None:
    one_thread()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--episodes", type=int, default=300)
    arguments = parser.parse_args()
    results = oodil.open_run(arguments.run_dir)
    demonstrations, found = results.demonstrations, results.transferability
    world = world_of(results.config.environment.dynamics)
    judge(results, demonstrations, world, found)
    for policy in results.policies:
        if results.is_done(policy.name):
            print(f"{policy.title}: {drive(results, policy.name, arguments.episodes)}")


if __name__ == "__main__":
    main()
