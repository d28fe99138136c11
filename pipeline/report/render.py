"""The page: everything that the template shows, as one typed structure, and its HTML.

Letters: N demonstrations, K clusters.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import jinja2
import numpy as np
import yaml
from markupsafe import Markup

from oodil.pipeline.algorithms.weights import effective_number
from oodil.pipeline.report import figures, formats, looks, paths, score_figures, summary
from oodil.pipeline.report.policies import PolicySection, read_policies
from oodil.pipeline.report.sources import Source, Sources
from oodil.pipeline.report.summary import Card, Findings, Note
from oodil.pipeline.report.trainings import read_trainings
from oodil.pipeline.results import Assignment, ClusterDiagnostics, Transferability
from oodil.pipeline.runs import POWERS, RunResults
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
    threshold: float
    effective_number: float
    alternatives: tuple[tuple[str, float, float], ...]
    """Weights that could have been, the transferable share and the effective number that they would have given."""
    convergence: Markup | None
    """None for a weighting without trainings of its own."""


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


@dataclass(frozen=True)
class PathsSection:
    """Where a weighting sees weight in the plane."""

    title: str
    figure: Markup


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


@dataclass(frozen=True)
class TrainingSection:
    """How some adversarial trainings went."""

    title: str
    figure: Markup


@dataclass(frozen=True)
class StageRow:
    """A stage in the table of stages."""

    name: str
    time: str
    env_steps: str
    sha256: str
    """Of the artifact; empty unless it can be used."""
    state: str
    """With its reason."""


@dataclass(frozen=True)
class Report:
    """Everything that the page shows."""

    name: str
    seed: int
    environment: str
    dynamics: str
    sources: Sources | None
    finding: str
    cards: tuple[Card, ...]
    notes: tuple[Note, ...]
    policies: PolicySection | None
    weightings: tuple[WeightingSection, ...]
    mixture: Mixture | None
    paths: tuple[PathsSection, ...]
    """For an environment whose demonstrations are paths in a plane."""
    clusters: ClusterSection | None
    trainings: tuple[TrainingSection, ...]
    stages: tuple[StageRow, ...]
    versions: str
    config: str


def render(results: RunResults) -> str:
    """Return the HTML of the report."""
    return _environment().get_template("report.html.j2").render(report=context(results))


def context(results: RunResults) -> Report:
    """Return everything that the page shows of a run, with its figures drawn."""
    config, found = results.config, Findings.of(results)
    sources, dynamics = found.sources, config.environment.dynamics
    assignment = results.assignment if results.is_done("clustering") else None
    return Report(
        name=config.name,
        seed=config.seed,
        environment=config.environment.id,
        dynamics=", ".join(
            f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}" for name, value in dynamics.items()
        ),
        sources=sources,
        finding=summary.finding(found),
        cards=tuple(summary.cards(found)),
        notes=tuple(summary.notes(found)),
        policies=read_policies(found),
        weightings=tuple(_weighting(found, sources, name) for name in found.ranking) if sources else (),
        mixture=_mixture(found, sources) if sources and found.weightings else None,
        paths=tuple(_paths(found, sources)) if sources else (),
        clusters=(
            _clusters(found, sources, assignment, found.diagnostics)
            if sources and assignment and found.diagnostics
            else None
        ),
        trainings=tuple(
            TrainingSection(title, figures.trainings(panels)) for title, panels in read_trainings(results).items()
        ),
        stages=tuple(_stages(results)),
        versions=_versions(results),
        config=yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, allow_unicode=True),
    )


@cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("oodil.pipeline.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {each.__name__: each for each in (formats.plural, formats.returned, formats.percent)}
    environment.filters["steps"] = formats.count
    environment.globals["training_colors"] = looks.TRAINING
    return environment


def _weighting(found: Findings, sources: Sources, name: str) -> WeightingSection:
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


def _mixture(found: Findings, sources: Sources) -> Mixture:
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
                f"{'yes' if chosen[label] else 'no'} ({distance:.3f})" if np.isfinite(distance) else "not known"
                for label, distance in known.by_source(sources.demonstrations).items()
            ]
        )
        told = reproducible(chosen)
    return Mixture(
        reproducibility=told,
        bars=tuple(
            Bar(title, tuple(zip(sources.each, map(float, each), strict=True))) for title, each in shares.items()
        ),
        columns=tuple(columns),
        rows=tuple(map(SourceRow, sources.each, zip(*values, strict=True))),
    )


def _paths(found: Findings, sources: Sources) -> Iterator[PathsSection]:
    world = paths.world_of(found.results.config.environment)
    if world is not None:
        for name, weighting in found.weightings.items():
            drawn = paths.paths(sources.demonstrations, weighting.weights, sources.looks, world)
            yield PathsSection(found.title(name), drawn)


def reproducible(sources: dict[str, bool]) -> str:
    """Say of which sources, by label, the imitator's simulator can follow every step."""
    if all(sources.values()):
        return "Every source can be reproduced: the imitator's simulator can follow its demonstrations."
    missing = ", ".join(label or "unnamed" for label, known in sources.items() if not known)
    return f"The imitator's simulator cannot follow the demonstrations of: {missing}."


def _clusters(
    found: Findings, sources: Sources, assignment: Assignment, diagnostics: ClusterDiagnostics
) -> ClusterSection:
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


def _stages(results: RunResults) -> list[StageRow]:
    seconds, env_steps = results.seconds(), results.env_steps()
    return [
        StageRow(
            name=name,
            time=formats.duration(seconds[name]) if name in seconds else formats.UNKNOWN,
            env_steps=f"{env_steps[name]:,}" if name in env_steps else formats.UNKNOWN,
            sha256=state.artifact.sha256 if state.artifact else "",
            state=f"{state.state}: {state.reason}" if state.reason else state.state,
        )
        for name, state in results.states.items()
    ]


def _versions(results: RunResults) -> str:
    """List the versions of libraries; where stages differ in one, name the stages of each."""
    found: dict[str, dict[str, list[str]]] = {}
    for name, state in results.states.items():
        for library, version in (state.artifact.versions if state.artifact else {}).items():
            found.setdefault(library, {}).setdefault(version, []).append(name)
    listed = []
    for library, versions in sorted(found.items()):
        each = [
            version if len(versions) == 1 else f"{version} ({', '.join(used)})" for version, used in versions.items()
        ]
        listed.append(f"{library} {' and '.join(each)}")
    return ", ".join(listed)
