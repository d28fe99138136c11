"""The demonstrations as the report needs them, and how each source is drawn."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.report.figures import Look, source_looks
from oodil.pipeline.results import Results


@dataclass(frozen=True)
class Source:
    """A demonstrator as the report shows it."""

    label: str
    transferable: bool | None
    count: int
    look: Look


@dataclass(frozen=True)
class Collection:
    """The demonstrations as the report needs them: whose they are and how many transitions each has."""

    sources: list[Source]
    source_of: NDArray[np.int32]
    """(N,) index into ``sources``."""
    transitions: NDArray[np.int64]
    """(N,)"""
    own_returns: list[float | None]
    """Mean return of each source in its own environment."""

    @property
    def looks(self) -> list[Look]:
        """One per source."""
        return [source.look for source in self.sources]

    @property
    def labelled(self) -> bool:
        """Whether it is known whose the demonstrations are."""
        return len(self.sources) > 1 or self.sources[0].transferable is not None

    def shares(self, mass: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return each source's share of a mass (N,)."""
        return np.asarray(np.bincount(self.source_of, mass, minlength=len(self.sources)) / mass.sum())


def read_collection(results: Results) -> Collection | None:
    """Return the collection of a run, or None until there is one; without labels it has one source."""
    arrays = results.arrays("demonstrations", "demonstrations.safetensors")
    if not arrays:
        return None
    described = results.json("demonstrations", "demonstrations.json")
    transitions = np.diff(arrays["offsets"]) - 1
    labels = described.get("source_labels") or ["all demonstrations"]
    source_of = arrays["sources"] if described.get("source_labels") else np.zeros(len(transitions), np.int32)
    transferable = described.get("transferable") or [None] * len(labels)
    counts = np.bincount(source_of, minlength=len(labels))
    looks = source_looks(transferable)
    sources = [
        Source(label, known, int(number), look)
        for label, known, number, look in zip(labels, transferable, counts, looks, strict=True)
    ]
    means = [float(np.mean(arrays["returns"][source_of == i])) if counts[i] else np.nan for i in range(len(labels))]
    return Collection(sources, source_of, transitions, [mean if np.isfinite(mean) else None for mean in means])
