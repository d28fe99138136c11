"""The page of a run: everything that the template shows, as one typed structure, and its HTML."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from markupsafe import Markup

from oodil.pipeline.report import figures, formats, paths, summary
from oodil.pipeline.report.clusters import ClusterSection, read_clusters
from oodil.pipeline.report.films import FilmSection, read_films
from oodil.pipeline.report.mixture import Mixture, read_mixture
from oodil.pipeline.report.pages import page
from oodil.pipeline.report.policies import PolicySection, read_policies
from oodil.pipeline.report.sources import Sources
from oodil.pipeline.report.summary import Card, Findings, Note
from oodil.pipeline.report.trainings import read_trainings
from oodil.pipeline.report.weightings import WeightingSection, read_weighting
from oodil.pipeline.runs import RunResults


@dataclass(frozen=True)
class PathsSection:
    """Where a weighting sees weight in the plane."""

    title: str
    figure: Markup


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
    """The first digits of the artifact's; empty unless it can be used."""
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
    films: FilmSection | None
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
    return page("report.html.j2", report=context(results))


def context(results: RunResults) -> Report:
    """Return everything that the page shows of a run, with its figures drawn."""
    config, found = results.config, Findings.of(results)
    sources, dynamics = found.sources, config.environment.dynamics
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
        films=read_films(found),
        policies=read_policies(found),
        weightings=tuple(read_weighting(found, sources, name) for name in found.ranking) if sources else (),
        mixture=read_mixture(found, sources) if sources and found.weightings else None,
        paths=tuple(_paths(found, sources)) if sources else (),
        clusters=read_clusters(found, sources) if sources else None,
        trainings=tuple(
            TrainingSection(title, figures.trainings(panels)) for title, panels in read_trainings(results).items()
        ),
        stages=tuple(_stages(results)),
        versions=_versions(results),
        config=yaml.safe_dump(_portable(config.model_dump(mode="json")), sort_keys=False, allow_unicode=True),
    )


def _portable(value: Any) -> Any:
    """Return a configuration with names in place of absolute paths, which say nothing elsewhere."""
    if isinstance(value, dict):
        return {key: _portable(held) for key, held in value.items()}
    if isinstance(value, list):
        return [_portable(held) for held in value]
    return Path(value).name if isinstance(value, str) and Path(value).is_absolute() else value


def _paths(found: Findings, sources: Sources) -> Iterator[PathsSection]:
    world = paths.world_of(found.results.config.environment)
    if world is not None:
        for name, weighting in found.weightings.items():
            drawn = paths.paths(sources.demonstrations, weighting.weights, sources.looks, world)
            yield PathsSection(found.title(name), drawn)


def _stages(results: RunResults) -> list[StageRow]:
    seconds, env_steps = results.seconds(), results.env_steps()
    return [
        StageRow(
            name=name,
            time=formats.duration(seconds[name]) if name in seconds else formats.UNKNOWN,
            env_steps=f"{env_steps[name]:,}" if name in env_steps else formats.UNKNOWN,
            sha256=state.artifact.sha256[:12] if state.artifact else "",
            state=f"{state.state}: {summary.reason_of(results, name)}" if state.reason else state.state,
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
