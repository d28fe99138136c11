"""What a finished run of configs/driving.yaml made of every path: figures to judge it by, and a picture of the plane.

A demonstration can be reproduced if it drives at the imitator's speed and never touches the imitator's obstacles, which
is known exactly. Run ``python benchmarks/driving_weights.py RUN_DIR --picture docs/driving_weights.png``; it prints the
scores by source and by whether the path is clear, and how many episodes of each policy reach the goal.

Letters: N demonstrations, P states of all of them.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from common import one_thread
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

import oodil
from oodil.pipeline.algorithms.weights import sampling_mass
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments import make_batch
from oodil.pipeline.environments.driving import GOAL, HEIGHT, STEP_REWARD, WIDTH, DrivingEnv, Layout, touches
from oodil.pipeline.evaluation import run_episodes
from oodil.pipeline.results import Transferability
from oodil.pipeline.runs import RunResults, separation_metrics
from oodil.pipeline.seeding import derive_key, numpy_rng


def world_of(dynamics: Mapping[str, float]) -> Layout:
    """Return the world that an environment with these dynamics has."""
    keywords: dict[str, Any] = dict(dynamics)
    return DrivingEnv(**keywords).layout


def positions(demonstrations: Demonstrations) -> NDArray[np.float64]:
    """Return (P, 2) in metres."""
    return np.asarray((demonstrations.observations[:, :2].astype(np.float64) / 2 + 0.5) * (WIDTH, HEIGHT))


def is_clear(demonstrations: Demonstrations, world: Layout) -> NDArray[np.bool_]:
    """Return (N,) whether each demonstration drives where the world has no obstacle."""
    x, y = positions(demonstrations).T
    heading = demonstrations.observations[:, 4].astype(np.float64)
    touched = np.any([touches(x, y, heading, box) for box in world.obstacles], axis=0)
    return ~np.logical_or.reduceat(touched, demonstrations.offsets[:-1])


def draw(demonstrations: Demonstrations, scores: NDArray[np.float64], world: Layout, titles: list[str]) -> Figure:
    """Draw the paths of each source over the imitator's obstacles; the darker, the more transferable (N,)."""
    figure = Figure(figsize=(11, 3.5), layout="constrained")
    panels = figure.subplots(1, len(titles), sharey=True)
    paths = np.split(positions(demonstrations), demonstrations.offsets[1:-1])
    shades = LinearSegmentedColormap.from_list("shades", ("#dfe4ea", "#6f9bd1", "#0b2a5b"))
    depth = Normalize(0, scores.max())
    for i, (axes, title) in enumerate(zip(panels, titles, strict=True)):
        axes.set_title(title, fontsize=9)
        axes.set(xlim=(0, WIDTH), ylim=(0, HEIGHT), aspect="equal", xlabel="m")
        for box, color in ((GOAL, "#2f7d4f"), *((box, "#cf4f1b") for box in world.obstacles)):
            corner = box.left, box.y - box.depth / 2
            axes.add_patch(Rectangle(corner, box.width, box.depth, color=color, alpha=0.55, linewidth=0, zorder=3))
        mine = np.flatnonzero(demonstrations.sources == i)
        mine = mine[np.argsort(scores[mine], kind="stable")]  # the darkest on top
        lines = LineCollection([paths[n] for n in mine], array=scores[mine], cmap=shades, norm=depth, linewidths=0.8)
        axes.add_collection(lines)
    figure.colorbar(ScalarMappable(depth, shades), ax=panels, label="transferability", pad=0.01, shrink=0.75)
    return figure


def judge(results: RunResults, demonstrations: Demonstrations, world: Layout, found: Transferability) -> list[str]:
    """Print what the scores make of paths that can be reproduced and of others; return a title for each source."""
    sources = results.config.demonstrations.sources
    clear = is_clear(demonstrations, world)
    at_its_speed = np.array([world_of(source.dynamics).speed == world.speed for source in sources])
    reproducible = clear & at_its_speed[demonstrations.sources]
    scores, uniform = found.scores, np.ones(len(demonstrations))
    before, plain, after = (sampling_mass(each, demonstrations) for each in (uniform, scores, found.weights))

    def shares(some: NDArray[np.bool_]) -> str:
        return f"sampling mass {before[some].sum():.1%}, plain {plain[some].sum():.1%}, as used {after[some].sum():.1%}"

    titles = []
    for i, source in enumerate(sources):
        mine = demonstrations.sources == i
        titles.append(f"{source.label}\nsampling mass {before[mine].sum():.0%}, weighted {after[mine].sum():.0%}")
        for kind, some in (("clear", mine & clear), ("blocked", mine & ~clear)):
            if some.any():
                spread = f"{scores[some].mean():.3g} ({scores[some].min():.3g} to {scores[some].max():.3g})"
                print(f"{source.label}, {kind}: {some.sum()}, score {spread}, {shares(some)}")
    both = 0 < reproducible.sum() < len(reproducible)
    auroc = separation_metrics(reproducible, scores, found.weights, demonstrations)["auroc"] if both else np.nan
    print(f"reproducible: {reproducible.sum()} of {len(reproducible)}, AUROC {auroc:.3f}, {shares(reproducible)}")
    return titles


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
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--episodes", type=int, default=300)
    arguments = parser.parse_args()
    results = oodil.open_run(arguments.run_dir)
    demonstrations, found = results.demonstrations, results.transferability
    world = world_of(results.config.environment.dynamics)
    titles = judge(results, demonstrations, world, found)
    for policy in results.policies:
        if results.is_done(policy.name):
            print(f"{policy.title}: {drive(results, policy.name, arguments.episodes)}")
    if arguments.picture:
        draw(demonstrations, found.scores, world, titles).savefig(arguments.picture, dpi=130)


if __name__ == "__main__":
    main()
