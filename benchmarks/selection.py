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
    """Return, by method, the trainings of each finished policy that had several; the first is the one that was kept."""
    found = defaultdict(list)
    for folder in sorted(path.parent for path in experiment.glob("*/config.json") if path.parent.name != "runner"):
        run = oodil.open_run(folder)
        for stage in run.policies:
            trainings = run.trainings(stage.name).trainings if run.is_done(stage.name) else ()
            if len(trainings) > 1:
                found[stage.name].append(
                    {
                        "run": folder.name,
                        "distances": [training.distance for training in trainings],
                        "returns": [training.mean_return for training in trainings],
                    }
                )
    return found


def judged(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the correlation over all policies, and what the choice within runs was worth."""
    distances, returns = (np.concatenate([run[key] for run in runs]) for key in ("distances", "returns"))
    by_run = [np.array(run["returns"]) for run in runs]
    return {
        "policies": len(returns),
        "rank_correlation": float(spearmanr(distances, returns).statistic),
        "mean_return": float(returns.mean()),
        "kept": float(np.mean([each[0] for each in by_run])),
        "best": float(np.mean([each.max() for each in by_run])),
        "kept_is_best": int(sum(each[0] == each.max() for each in by_run)),
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
