"""What the policies learn from: how the sources share the drawn transitions under each weighting."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from oodil.pipeline.report import formats
from oodil.pipeline.report.sources import Source, Sources
from oodil.pipeline.report.summary import Findings


@dataclass(frozen=True)
class Bar:
    """How the drawn transitions are shared among the sources under some weights."""

    title: str
    shares: tuple[tuple[Source, float], ...]


@dataclass(frozen=True)
class SourceRow:
    """A source in the table of sources."""

    source: Source
    cells: tuple[str, ...]
    """One for each of the mixture's columns."""


@dataclass(frozen=True)
class Mixture:
    """What policies learn from under each weighting."""

    bars: tuple[Bar, ...]
    columns: tuple[str, ...]
    rows: tuple[SourceRow, ...]
    reproducibility: str
    """Which sources the imitator's simulator can follow; empty where it was not tried."""


def read_mixture(found: Findings, sources: Sources) -> Mixture:
    """Return the mixtures of all finished weightings, and the unweighted one."""
    only = len(found.results.weightings) == 1
    unweighted = sources.shares(np.ones(len(sources.demonstrations)))
    shares = {"unweighted": unweighted}
    columns = ["return in its own dynamics", "share, unweighted"]
    values = [
        [formats.returned(source.own_return) for source in sources.each],
        [formats.percent(share) for share in unweighted],
    ]
    for name, weighting in found.weightings.items():
        title = found.title(name)
        shares["weighted" if only else f"weighting “{title}”"] = own = sources.shares(weighting.weights)
        columns.append("share, weighted" if only else f"share, {title}")
        values.append([formats.percent(share) for share in own])
    told = ""
    if found.results.is_done("reproducibility"):
        known = found.results.reproducibility
        chosen = known.reproducible_sources(sources.demonstrations)
        columns.append("can be reproduced (distance)")
        values.append(
            [
                f"{'yes' if is_reproducible else 'no'} ({distance:.3f})" if np.isfinite(distance) else "not known"
                for is_reproducible, distance in zip(chosen, known.by_source(sources.demonstrations), strict=True)
            ]
        )
        told = _reproducible(sources.demonstrations.source_labels, chosen)
    return Mixture(
        reproducibility=told,
        bars=tuple(
            Bar(title, tuple(zip(sources.each, map(float, each), strict=True))) for title, each in shares.items()
        ),
        columns=tuple(columns),
        rows=tuple(map(SourceRow, sources.each, zip(*values, strict=True))),
    )


def _reproducible(labels: Sequence[str], chosen: Sequence[bool]) -> str:
    """Say of which sources the imitator's simulator can follow every step."""
    if all(chosen):
        return "Every source can be reproduced: the imitator's simulator can follow its demonstrations."
    missing = ", ".join(label or "unnamed" for label, known in zip(labels, chosen, strict=True) if not known)
    return f"The imitator's simulator cannot follow the demonstrations of: {missing}."
