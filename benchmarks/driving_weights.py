"""What a finished run of configs/driving.yaml made of every path: a picture in the plane, and figures to judge it by.

A demonstration can be reproduced if it drives at the imitator's speed and never touches the imitator's obstacles, which
is known exactly. Run ``python benchmarks/driving_weights.py RUN_DIR --picture docs/driving_weights.png``; it prints the
scores by source and by whether the path is clear, and for each policy the share of episodes that reach the goal.

Letters: N demonstrations, P states of all of them.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pipeline.algorithms.transferability import sampling_mass
from pipeline.data import Demonstrations
from pipeline.environments import make_batch
from pipeline.environments.driving import GOAL, HEIGHT, STEP_REWARD, WIDTH, Layout, layout, touches
from pipeline.evaluation import run_episodes
from pipeline.policy import GaussianPolicy
from pipeline.seeding import derive_key, generator
from pipeline.stages.demonstrations import load_demonstrations
from walk import read_run

POLICIES = {"imitation": "ours", "naive_gail": "naive GAIL", "oracle": "oracle"}


def positions(demonstrations: Demonstrations) -> NDArray[np.float64]:
    """Return (P, 2) in metres."""
    return np.asarray((demonstrations.observations[:, :2].astype(np.float64) / 2 + 0.5) * (WIDTH, HEIGHT))


def is_clear(demonstrations: Demonstrations, world: Layout) -> NDArray[np.bool_]:
    """Return (N,) whether each demonstration drives where the world has no obstacle."""
    x, y = positions(demonstrations).T
    heading = demonstrations.observations[:, 4].astype(np.float64)
    touched = np.any([touches(x, y, heading, box) for box in world.obstacles], axis=0)
    return ~np.logical_or.reduceat(touched, demonstrations.offsets[:-1])


def draw(demonstrations: Demonstrations, weights: NDArray[np.float64], world: Layout, titles: list[str]) -> Figure:
    """Draw the paths of each source over the imitator's obstacles; the darker, the larger the weight."""
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    panels = figure.subplots(1, len(titles), sharey=True)
    paths = np.split(positions(demonstrations), demonstrations.offsets[1:-1])
    depths = 0.04 + 0.96 * weights / weights.max()
    for i, (axes, title) in enumerate(zip(panels, titles, strict=True)):
        axes.set_title(title, fontsize=9)
        axes.set(xlim=(0, WIDTH), ylim=(0, HEIGHT), aspect="equal", xlabel="m")
        for box in world.obstacles:
            corner = box.left, box.y - box.depth / 2
            axes.add_patch(Rectangle(corner, box.width, box.depth, color="#cf4f1b", alpha=0.55, linewidth=0, zorder=3))
        strip = GOAL.left, GOAL.y - GOAL.depth / 2
        axes.add_patch(Rectangle(strip, GOAL.width, GOAL.depth, color="#2f7d4f", alpha=0.5, linewidth=0))
        mine = np.flatnonzero(demonstrations.sources == i)
        mine = mine[np.argsort(depths[mine], kind="stable")]
        colours = [(0.05, 0.15, 0.35, depth) for depth in depths[mine]]
        axes.add_collection(LineCollection([paths[n] for n in mine], colors=colours, linewidths=0.7, zorder=2))
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--episodes", type=int, default=300)
    arguments = parser.parse_args()
    run = read_run(arguments.run_dir)
    demonstrations = load_demonstrations(run)
    dynamics = run.config.environment.dynamics
    world = layout(**dynamics)
    results = run.artifact("transferability").arrays("transferability.safetensors")
    scores, weights = results["scores"], results["weights"]
    mass, before = (sampling_mass(each, demonstrations) for each in (weights, np.ones(len(weights))))
    clear = is_clear(demonstrations, world)
    sources = run.config.demonstrations.sources
    at_its_speed = np.array([source.dynamics["speed"] == world.speed for source in sources])
    reproducible = clear & at_its_speed[demonstrations.sources]
    titles = []
    for i, source in enumerate(sources):
        mine = demonstrations.sources == i
        titles.append(f"{source.label}: {mass[mine].sum():.0%} of the sampling mass")
        for kind, some in (("clear", mine & clear), ("blocked", mine & ~clear)):
            if some.any():
                low, high = scores[some].min(), scores[some].max()
                print(
                    f"{source.label}, {kind}: {some.sum()} demonstrations, score {scores[some].mean():.4f} "
                    f"({low:.4f} to {high:.4f}), mass {before[some].sum():.1%} -> {mass[some].sum():.1%}"
                )
    print(
        f"reproducible: {reproducible.sum()} of {len(reproducible)}, AUROC {roc_auc_score(reproducible, scores):.3f}, "
        f"mass {before[reproducible].sum():.1%} -> {mass[reproducible].sum():.1%}"
    )
    for stage, name in POLICIES.items():
        policy = GaussianPolicy.from_arrays(run.artifact(stage).arrays("policy.safetensors"))
        cars = make_batch(run.config.environment.id, dynamics, arguments.episodes)
        episodes = run_episodes(cars, policy, generator(derive_key(run.config.seed, "benchmark")), stochastic=False)
        returns = np.array([episode.env_return for episode in episodes])
        steps = np.array([len(episode.states) - 1 for episode in episodes])
        reached = returns - STEP_REWARD * steps > 0
        print(f"{name}: return {returns.mean():.0f}, reached the goal {reached.mean():.1%}, {steps.mean():.0f} steps")
    if arguments.picture:
        draw(demonstrations, weights, world, titles).savefig(arguments.picture, dpi=130)


if __name__ == "__main__":
    main()
