"""Clusters on the page: the embedding, and which sources fell into which of them. Letters: K clusters."""

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from oodil.pipeline.report import figures, formats
from oodil.pipeline.report.sources import Source, Sources
from oodil.pipeline.report.summary import Findings
from oodil.pipeline.results import Transferability


@dataclass(frozen=True)
class ContingencyRow:
    """The demonstrations of a source by cluster."""

    source: Source
    cells: tuple[tuple[int, float], ...]
    """Their number in each cluster in use, and their share of the source."""


@dataclass(frozen=True)
class ClusterSection:
    """How the demonstrations are clustered."""

    figure: Markup | None
    projection: str
    clusters: tuple[int, ...]
    """Ids of those in use."""
    contingency: tuple[ContingencyRow, ...]
    mean_scores: tuple[tuple[str, tuple[str, ...]], ...]
    """Title of a weighting that scores within these clusters, and its mean score in each."""
    quality: tuple[str, ...]
    suggestion: str
    """How many clusters the embedding suggests; empty where it tells too little apart."""


def read_clusters(found: Findings, sources: Sources) -> ClusterSection | None:
    """Return how the demonstrations are clustered; None while they are not."""
    diagnostics = found.diagnostics
    if diagnostics is None:
        return None
    assignment = found.results.assignment
    projected = figures.project(assignment.features)
    drawn, projection = None, ""
    if projected is not None:
        points, projection = projected
        drawn = figures.embedding(points, assignment.labels, sources.index, sources.looks)
    used = [k for k, size in enumerate(diagnostics.cluster_sizes) if size]
    rows = [
        ContingencyRow(source, tuple((counts[k], counts[k] / max(sum(counts), 1)) for k in used))
        for source, counts in zip(sources.each, diagnostics.contingency, strict=True)
    ]
    quality = (
        ("silhouette", diagnostics.silhouette, 3),
        ("Calinski-Harabasz", diagnostics.calinski_harabasz, 1),
        ("label stability", diagnostics.label_stability, 3),
        ("purity", diagnostics.purity, 3),
    )
    return ClusterSection(
        figure=drawn,
        projection=projection,
        clusters=tuple(used),
        contingency=tuple(rows),
        mean_scores=tuple(
            (found.title(name), _means(weighting, used))
            for name, weighting in found.weightings.items()
            if np.array_equal(weighting.clusters, assignment.labels)
        ),
        suggestion=found.results.suggestion.text if found.results.suggestion else "",
        quality=tuple(
            f"{name} {formats.decimal(value, digits)}" for name, value, digits in quality if value is not None
        ),
    )


def _means(weighting: Transferability, clusters: list[int]) -> tuple[str, ...]:
    return tuple(formats.decimal(float(weighting.scores[weighting.clusters == k].mean())) for k in clusters)
