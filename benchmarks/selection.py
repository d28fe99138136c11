"""Whether the distance to the demonstrations, which needs no reward, ranks policies as their true returns do.

Of all final policies in the folders of one or more experiments (`oodil table`), by experiment and method: distance,
return, their rank correlation, and what keeping the closest training of a run gained over the mean of its trainings
and left to the best one. Run ``python benchmarks/selection.py TABLES/untouched_hopper ... --json FILE``.
"""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments_of, circumstances, save
from scipy.stats import spearmanr

import oodil


def trainings_of(experiment: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the trainings of every finished policy by method, those of one run one after another."""
    found = defaultdict(list)
    for folder in sorted(path.parent for path in experiment.glob("*/config.json") if path.parent.name != "runner"):
        run = oodil.open_run(folder)
        for stage in run.policies:
            if run.is_done(stage.name):
                kept, *others = run.trainings(stage.name).trainings
                found[stage.name].append(
                    {
                        "run": folder.name,
                        "distances": [kept.distance, *(each.distance for each in others)],
                        "returns": [kept.mean_return, *(each.mean_return for each in others)],
                    }
                )
    return found


def judged(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the correlation over all policies, and what the choice within runs was worth."""
    distances, returns = (np.concatenate([run[key] for run in runs]) for key in ("distances", "returns"))
    several = [np.array(run["returns"]) for run in runs if len(run["returns"]) > 1]
    return {
        "policies": len(returns),
        "rank_correlation": float(spearmanr(distances, returns).statistic) if len(returns) > 2 else None,
        "mean_return": float(returns.mean()),
        "kept": float(np.mean([each[0] for each in several])),
        "best": float(np.mean([each.max() for each in several])),
        "kept_is_best": int(sum(each[0] == each.max() for each in several)),
        "runs": runs,
    }


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("experiments", nargs="+", type=Path, metavar="FOLDER")
    arguments = parser.parse_args()
    found = circumstances() | {"experiments": {}}
    for experiment in arguments.experiments:
        methods = {method: judged(runs) for method, runs in trainings_of(experiment).items()}
        found["experiments"][experiment.name] = methods
        for method, figures in methods.items():
            print(experiment.name, method, json.dumps({k: v for k, v in figures.items() if k != "runs"}))
    save(arguments.json, found)


if __name__ == "__main__":
    main()
