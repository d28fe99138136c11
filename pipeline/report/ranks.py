"""The best and the worst demonstrations of a weighting, by their numbers in the file."""

from dataclasses import dataclass

import numpy as np

from oodil.pipeline.report.sources import Source, Sources
from oodil.pipeline.results import Transferability

ENDS = 5
"""Demonstrations at either end."""


@dataclass(frozen=True)
class RankRow:
    """A demonstration in the table of the best and the worst."""

    rank: int
    """From 1, the best."""
    number: int
    """Of the demonstration, from 0, as in the file."""
    source: Source
    cluster: str
    num_states: int
    score: float
    low: float
    high: float
    verdict: str


def best_and_worst(found: Transferability, sources: Sources) -> tuple[RankRow, ...]:
    """Return the demonstrations with the highest and the lowest scores, the best first; all, if they are few."""
    scored = np.flatnonzero(np.isfinite(found.scores))
    order = scored[np.argsort(-found.scores[scored], kind="stable")]
    ranks = list(range(len(order)))
    if len(order) > 2 * ENDS:
        ranks = ranks[:ENDS] + ranks[-ENDS:]
    verdicts = found.verdicts
    rows = []
    for rank in ranks:
        n = int(order[rank])
        low, high = found.intervals[n].tolist()
        rows.append(
            RankRow(
                rank=rank + 1,
                number=n,
                source=sources.each[sources.index[n]],
                cluster=str(found.clusters[n]) if found.clusters[n] >= 0 else "",
                num_states=int(sources.demonstrations.lengths[n]),
                score=float(found.scores[n]),
                low=low,
                high=high,
                verdict=str(verdicts[n]),
            )
        )
    return tuple(rows)
