"""What clusters become that begin at k-means of the features, and at k-means or average linkage by the silhouette.

For the demonstrations of runs, and several seeds of the encoder: the silhouette by cosine of the groups that training
begins with; after training, purity and how many demonstrations of other sources lie in clusters that are the home of a
source marked transferable (where most of that source lies).
Run ``python benchmarks/initial_centers.py RUN_DIR ... --seeds 0-4 --json FILE``.
"""

from pathlib import Path
from typing import Any

import numpy as np
from common import arguments_of, circumstances, one_thread, save, seeds_of

import oodil
from oodil.pipeline.algorithms.clustering import ContrastiveClustering
from oodil.pipeline.config import ClusteringConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.results import ClusterDiagnostics
from oodil.pipeline.stages.clustering import diagnostics


def measure(demonstrations: Demonstrations, marked: list[bool], section: ClusteringConfig, seed: int) -> dict[str, Any]:
    clustering = ContrastiveClustering(demonstrations, section, seed)
    at_first, at_last = (
        judged(clustering, until, demonstrations, seed)
        for until in (section.warmup_iterations, clustering.num_iterations)
    )
    table = np.array(at_last.contingency)
    homes = sorted({int(counts.argmax()) for counts, mark in zip(table, marked, strict=True) if mark})
    return {
        "silhouette_at_first": at_first.silhouette,
        "purity": at_last.purity,
        "others_at_home": int(table[~np.array(marked)][:, homes].sum()),
        "contingency": table.tolist(),
    }


def judged(
    clustering: ContrastiveClustering, until: int, demonstrations: Demonstrations, seed: int
) -> ClusterDiagnostics:
    while clustering.iteration < until:
        clustering.update()
    labeling = clustering.model().label(demonstrations, clustering.config.label_draws, seed)
    return diagnostics(labeling, demonstrations, clustering.config.num_clusters)


def main() -> None:
    one_thread()
    parser = arguments_of(__doc__)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN_DIR", help="a run whose demonstrations are made")
    parser.add_argument("--seeds", type=seeds_of, help="seeds of the encoder, instead of each run's own")
    arguments = parser.parse_args()
    found = circumstances() | {"clusterings": []}
    for folder in arguments.runs:
        run = oodil.open_run(folder)
        marked = [source.transferable is True for source in run.config.demonstrations.sources]
        for seed in arguments.seeds or [run.config.seed]:
            for centers in ("kmeans", "silhouette"):
                section = run.config.clustering.model_copy(update={"initial_centers": centers})
                row = {"config": run.config.name, "demonstrations": len(run.demonstrations)}
                row |= {"demonstrations_seed": run.config.seed, "encoder_seed": seed, "initial_centers": centers}
                row |= measure(run.demonstrations, marked, section, seed)
                print(row, flush=True)
                found["clusterings"].append(row)
    save(arguments.json, found)


if __name__ == "__main__":
    main()
