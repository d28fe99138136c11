"""What a weighting says of the demonstrations as a whole: by source, by cluster, and of all of them.

Letters: N demonstrations, K clusters.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.algorithms.weights import effective_number, sampling_mass
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.results import Transferability

MEANING = "1: cannot be told from the imitator's own fresh episodes; 0: nothing of it is reproduced"
"""What a score of a weighting that trains imitators says."""
LITTLE = 0.02
"""Below it, nothing is reproduced well. The threshold cannot say so: it is relative to the best mode, so that
something is kept even where nothing can be reproduced. At a score of 0.02, D = 0.99: whoever looks at a demonstration
and at the imitator, and is wrong in one of twenty cases, calls them different, by the usual measure of doubt."""


@dataclass(frozen=True)
class Verdicts:
    """What is said of some demonstrations together."""

    name: str
    """Of a source; the number of a cluster."""
    demonstrations: int
    kept: int
    open: int
    unlike: int
    """Those without a score, which nothing below speaks of but the shares."""
    score: float
    """Mean of their scores; NaN if none has any."""
    low: float
    """Mean of the lower ends of their intervals."""
    high: float
    """Mean of the upper ends."""
    share_before: float
    """Of the sampling mass, without weights."""
    share: float
    """Of the sampling mass, with weights."""

    @property
    def not_kept(self) -> int:
        """How many are not kept."""
        return self.demonstrations - self.kept - self.open - self.unlike


@dataclass(frozen=True)
class VerdictTable:
    """What is said of all demonstrations; groups without demonstrations are left out."""

    by_source: tuple[Verdicts, ...]
    """In the order of the sources."""
    by_cluster: tuple[Verdicts, ...]
    """The best first; empty for a weighting without clusters."""
    threshold: float
    """From which score a demonstration is kept."""
    effective_number: float
    """How many demonstrations of equal weight would be as even."""
    drawn_score: float | None
    """Mean score of the demonstrations that weigh more than nothing; none if there are none."""

    @classmethod
    def of(cls, found: Transferability, demonstrations: Demonstrations) -> "VerdictTable":
        """Count and average by source and by cluster."""
        masses = (
            sampling_mass(np.ones(len(demonstrations)), demonstrations),
            sampling_mass(found.weights, demonstrations),
        )
        sources = [
            _verdicts(label or "unnamed", demonstrations.sources == i, found, masses)
            for i, label in enumerate(demonstrations.source_labels)
            if (demonstrations.sources == i).any()
        ]
        known = np.unique(found.clusters[found.clusters >= 0]).tolist()
        clusters = [_verdicts(str(k), found.clusters == k, found, masses) for k in known]
        best_first = tuple(sorted(clusters, key=lambda each: -np.nan_to_num(each.score)))
        drawn = found.scores[found.weights > 0]
        score = float(drawn.mean()) if len(drawn) else None
        return cls(tuple(sources), best_first, found.threshold, effective_number(found.weights), score)

    @property
    def warning(self) -> str:
        """That nothing is reproduced well, if so: the mean score of what is drawn says it."""
        if not self.by_cluster or self.drawn_score is None or self.drawn_score >= LITTLE:
            return ""
        return (
            "Nothing is reproduced well: the demonstrations that are drawn have a mean score of only "
            f"{self.drawn_score:.3f}, below {LITTLE:g}. They are the best there are, not good ones: train the "
            "imitators for longer, or the imitator cannot do what was demonstrated."
        )

    def describe(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return asdict(self) | {"nothing_reproduced_well": bool(self.warning)}


def _verdicts(
    name: str,
    chosen: NDArray[np.bool_],
    found: Transferability,
    masses: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> Verdicts:
    verdicts, scored = found.verdicts[chosen], chosen & np.isfinite(found.scores)
    score, low, high = float("nan"), float("nan"), float("nan")
    if scored.any():
        score = float(found.scores[scored].mean())
        low, high = found.intervals[scored].mean(axis=0).tolist()
    before, after = (float(mass[chosen].sum()) for mass in masses)
    return Verdicts(
        name=name,
        demonstrations=int(chosen.sum()),
        kept=int((verdicts == "kept").sum()),
        open=int((verdicts == "open").sum()),
        unlike=int((verdicts == "unlike").sum()),
        score=score,
        low=low,
        high=high,
        share_before=before,
        share=after,
    )
