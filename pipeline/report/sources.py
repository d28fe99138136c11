"""The demonstrations as the report shows them: who produced them, and how each source is drawn.

Letters: N demonstrations.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.algorithms.weights import sampling_mass
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.report.looks import Look, source_looks
from oodil.pipeline.results import Transferability
from oodil.pipeline.runs import RunResults
from oodil.pipeline.stages.demonstrations import transferable_marks


@dataclass(frozen=True)
class Source:
    """A demonstrator."""

    label: str
    transferable: bool | None
    """Whether the configuration marks it transferable; None if it does not say."""
    count: int
    """Number of its demonstrations."""
    own_return: float
    """Mean return in the demonstrator's own environment; NaN where unknown."""
    look: Look


@dataclass(frozen=True)
class Sources:
    """The demonstrations by source."""

    each: tuple[Source, ...]
    demonstrations: Demonstrations

    @property
    def index(self) -> NDArray[np.int32]:
        """(N,) source of each demonstration."""
        return self.demonstrations.sources

    @property
    def looks(self) -> list[Look]:
        """How each source is drawn."""
        return [source.look for source in self.each]

    @property
    def distinguished(self) -> bool:
        """Whether the page tells sources apart: there are several, or the only one is marked."""
        return len(self.each) > 1 or self.each[0].transferable is not None

    @property
    def fully_marked(self) -> bool:
        """Whether every source is marked transferable or not transferable."""
        return all(source.transferable is not None for source in self.each)

    def shares(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return each source's share of the transitions drawn under weights (N,)."""
        mass = sampling_mass(weights, self.demonstrations)
        return np.bincount(self.index, mass, minlength=len(self.each)).astype(np.float64)


def read_sources(results: RunResults) -> Sources | None:
    """Return the demonstrations of a run by source; None while the run has none."""
    if not results.is_done("demonstrations"):
        return None
    demonstrations = results.demonstrations
    labels = demonstrations.source_labels
    marks = transferable_marks(results.config, labels)
    columns = zip(labels, marks, source_looks(marks), strict=True)
    each = []
    for i, (label, transferable, look) in enumerate(columns):
        returns = demonstrations.returns[demonstrations.sources == i]
        own_return = float(returns.mean()) if len(returns) else float("nan")
        each.append(Source(label or "unnamed", transferable, len(returns), own_return, look))
    return Sources(tuple(each), demonstrations)


def ranks_demonstrations(found: Transferability, sources: Sources) -> bool:
    """Return whether a weighting looks at single demonstrations: it has clusters, or tells some of a source apart.

    A weighting that only repeats something known of the sources, such as their marks, has no figure of its own.
    """
    if found.history or (found.clusters >= 0).any():
        return True
    scores = [found.scores[sources.index == i] for i in range(len(sources.each))]
    return any(len(own) and np.ptp(own) > 0 for own in scores)
