"""What finished runs of configs/driving.yaml made of every path, against the truth, which is known exactly there.

A demonstration can be reproduced if it drives at the imitator's speed and never touches the imitator's obstacles. For
every weighting of a run: the AUROC of that truth, its share of the sampling mass before and after weighting, and scores
by source and by whether the path is clear; for every policy, how many episodes reach the goal, also by the third of the
start line that they begin in. ``--picture FILE`` draws the paths of the last run, shaded by each weighting.

Run ``python benchmarks/driving_weights.py RUN_DIR... --json FILE``.

Letters: N demonstrations.
"""

from pathlib import Path
from typing import Any

import numpy as np
from common import arguments_of, circumstances, one_thread, save
from numpy.typing import NDArray

import oodil
from oodil.pipeline.config import EnvironmentConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments import make_batch
from oodil.pipeline.environments.driving_world import WIDTH, Layout, positions, touches
from oodil.pipeline.environments.goals import reached_goal
from oodil.pipeline.evaluation import run_episodes
from oodil.pipeline.report.paths import sheet, world_of
from oodil.pipeline.results import Transferability
from oodil.pipeline.runs import RunResults, separation_metrics
from oodil.pipeline.seeding import derive_key, numpy_rng


def layout(environment: EnvironmentConfig) -> Layout:
    """Return the world of an environment. Raises ValueError for one that is not a road."""
    world = world_of(environment)
    if world is None:
        raise ValueError(f"{environment.id}: nothing is driven there")
    return world


def is_clear(demonstrations: Demonstrations, world: Layout) -> NDArray[np.bool_]:
    """Return (N,) whether each demonstration drives where the world has no obstacle."""
    x, y = positions(demonstrations.observations).T
    heading = demonstrations.observations[:, 4].astype(np.float64)
    touched = np.any([touches(x, y, heading, box) for box in world.obstacles], axis=0)
    return ~np.logical_or.reduceat(touched, demonstrations.offsets[:-1])


def judged(
    found: Transferability, demonstrations: Demonstrations, clear: NDArray[np.bool_], reproducible: NDArray[np.bool_]
) -> dict[str, Any]:
    """Return what a weighting makes of paths that can be reproduced and of others, by source too."""
    told = separation_metrics(reproducible, found.scores, found.weights, demonstrations)
    kinds = {}
    for source, label in enumerate(demonstrations.source_labels):
        for kind, some in (("clear", clear), ("blocked", ~clear)):
            scores = found.scores[some & (demonstrations.sources == source)]
            if len(scores):
                line = {"paths": len(scores), "mean": scores.mean(), "lowest": scores.min(), "highest": scores.max()}
                kinds[f"{label}, {kind}"] = {key: float(value) for key, value in line.items()}
    return {key: told[key] for key in ("auroc", "share_before", "share", "effective_number")} | {"scores": kinds}


def driven(results: RunResults, policy: str, num_episodes: int) -> dict[str, Any]:
    """Return what a policy does in fresh episodes, also by the third of the start line that they begin in."""
    environment = results.config.environment
    cars = make_batch(environment.id, environment.dynamics, num_episodes)
    rng = numpy_rng(derive_key(results.config.seed, "benchmark"))
    episodes = run_episodes(cars, results.policy(policy).gaussian, rng, stochastic=False)
    returns = np.array([episode.env_return for episode in episodes])
    steps = np.array([len(episode.states) - 1 for episode in episodes])
    third = np.array([(episode.states[0, 0] / 2 + 0.5) * WIDTH // 25 for episode in episodes])
    reached = reached_goal(environment.id, returns, steps, cars.max_episode_steps)
    assert reached is not None
    by_third = [float(reached[third == i].mean()) for i in range(3)]
    return {"mean_return": float(returns.mean()), "share_reached": float(reached.mean()), "by_third": by_third}


def figures_of(results: RunResults, num_episodes: int) -> dict[str, Any]:
    """Return what every weighting and every policy of a run have found."""
    config, demonstrations = results.config, results.demonstrations
    world = layout(config.environment)
    speeds = [layout(EnvironmentConfig(id=config.environment.id, dynamics=source.dynamics)).speed
              for source in config.demonstrations.sources]  # fmt: skip
    clear = is_clear(demonstrations, world)
    reproducible = clear & (np.array(speeds) == world.speed)[demonstrations.sources]
    return {
        "run": results.path.name,
        "seed": config.seed,
        "paths": len(demonstrations),
        "reproducible": int(reproducible.sum()),
        "purity": results.cluster_diagnostics.purity,
        "weightings": {
            each.title: judged(results.weighting(each.name), demonstrations, clear, reproducible)
            for each in results.weightings
            if results.is_done(each.name)
        },
        "policies": {
            each.title: driven(results, each.name, num_episodes)
            for each in results.policies
            if results.is_done(each.name)
        },
    }


def main() -> None:
    one_thread()
    parser = arguments_of(__doc__)
    parser.add_argument("run_dirs", type=Path, nargs="+", metavar="RUN_DIR")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--picture", type=Path, metavar="FILE", help="an SVG of the last run's paths")
    arguments = parser.parse_args()
    figures: dict[str, Any] = circumstances() | {"episodes": arguments.episodes, "runs": []}
    for run_dir in arguments.run_dirs:
        found = figures_of(oodil.open_run(run_dir), arguments.episodes)
        figures["runs"].append(found)
        print(f"{found['run']}: {found['reproducible']} of {found['paths']} paths can be reproduced")
        for name, line in found["weightings"].items():
            print(f"  {name}: AUROC {line['auroc']:.3f}, share {line['share_before']:.1%} -> {line['share']:.1%}")
        for name, line in found["policies"].items():
            thirds = ", ".join(f"{share:.0%}" for share in line["by_third"])
            print(f"  {name}: {line['share_reached']:.1%} arrive ({thirds}), return {line['mean_return']:.0f}")
    save(arguments.json, figures)
    if arguments.picture:
        results = oodil.open_run(arguments.run_dirs[-1])
        done = [each for each in results.weightings if results.is_done(each.name)]
        weights = {each.title: results.weighting(each.name).weights for each in done}
        drawn = sheet(results.demonstrations, weights, layout(results.config.environment))
        arguments.picture.write_text(drawn + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
