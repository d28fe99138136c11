"""Weightings on the page: what each says of single demonstrations, and what other weights would have given."""

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from oodil.pipeline.algorithms.weights import effective_number
from oodil.pipeline.report import score_figures
from oodil.pipeline.report.ranks import RankRow, best_and_worst
from oodil.pipeline.report.sources import Source, Sources
from oodil.pipeline.report.summary import Findings
from oodil.pipeline.results import Transferability
from oodil.pipeline.runs import POWERS
from oodil.pipeline.verdicts import MEANING, Verdicts, VerdictTable


@dataclass(frozen=True)
class WeightingSection:
    """What a weighting says of single demonstrations."""

    title: str
    meaning: str
    """What a score says; empty for a weighting without trainings of its own."""
    rule: str
    """How weights follow from scores."""
    figure: Markup
    by_source: tuple[tuple[Source, Verdicts], ...]
    by_cluster: tuple[Verdicts, ...]
    ranks: tuple[RankRow, ...]
    """The best and the worst demonstrations."""
    threshold: float
    effective_number: float
    alternatives: tuple[tuple[str, float, float], ...]
    """Weights that could have been, the transferable share and the effective number that they would have given."""
    convergence: Markup | None
    """None for a weighting without trainings of its own."""


def read_weighting(found: Findings, sources: Sources, name: str) -> WeightingSection:
    """Return what a finished weighting says."""
    weighting = found.weightings[name]
    colors = {}
    for cluster, history in weighting.history.items():
        most_frequent = int(np.bincount(sources.index[history.demonstrations]).argmax())
        colors[cluster] = sources.looks[most_frequent].color
    table = VerdictTable.of(weighting, sources.demonstrations)
    return WeightingSection(
        title=found.title(name),
        meaning=MEANING if weighting.history else "",
        rule=found.rule(name),
        by_source=tuple(zip((each for each in sources.each if each.count), table.by_source, strict=True)),
        by_cluster=table.by_cluster,
        ranks=best_and_worst(weighting, sources),
        threshold=table.threshold,
        effective_number=table.effective_number,
        alternatives=_alternatives(weighting, found.separation.get(name, {})),
        figure=score_figures.transferability(weighting, sources.index, sources.looks),
        convergence=score_figures.convergence(weighting, colors) if weighting.history else None,
    )


def _alternatives(weighting: Transferability, shares: dict[str, float]) -> tuple[tuple[str, float, float], ...]:
    """Return what other weights would have given, of what `RunResults.separation` returns; nothing if it is empty."""
    weights = {"none": ("share_before", np.ones(len(weighting.scores))), "the rule": ("share", weighting.weights)}
    for power in POWERS:
        title = "score" if power == 1 else f"score to the power of {power}"
        raised = weighting.scores**power
        weights[title] = (f"share_power_{power}", raised if raised.any() else np.ones(len(raised)))
    return tuple((title, shares[key], effective_number(each)) for title, (key, each) in weights.items() if shares)
