"""The top of the page: the finding, the figures that a reader looks for first, and their limits."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from oodil.pipeline.report import formats
from oodil.pipeline.report.sources import Sources, ranks_demonstrations, read_sources
from oodil.pipeline.results import ClusterDiagnostics, Evaluation, Transferability
from oodil.pipeline.runs import RunResults

MOST_NAMED = 6
"""Sources in the finding."""
FEW_EPISODES = 20
"""A mean return over fewer episodes is called rough."""
UNSTABLE_LABELS = 0.9
"""Clusters are called unstable if a smaller share of labels survives another draw."""
STATES = {
    "pending": "not computed yet",
    "partial": "not finished",
    "stale": "stale: {}",
    "damaged": "damaged: {}",
}


@dataclass(frozen=True)
class Card:
    """One figure with its title."""

    title: str
    figure: str
    note: str = ""
    before: str = ""
    """The figure without weighting, if there is one to compare with."""

    @property
    def known(self) -> bool:
        """Whether there is a figure."""
        return self.figure != formats.UNKNOWN


@dataclass(frozen=True)
class Note:
    """A limit of the figures on the page."""

    text: str
    lead: str = ""
    """What stands in bold before the text."""


@dataclass(frozen=True)
class Findings:
    """The typed results that the page is made of; stages that cannot be used are left out."""

    results: RunResults
    sources: Sources | None
    finals: dict[str, Evaluation]
    """By policy."""
    weightings: dict[str, Transferability]
    """By weighting; empty without demonstrations."""
    diagnostics: ClusterDiagnostics | None
    ranking: tuple[str, ...]
    """The weightings that rank demonstrations, see `ranks_demonstrations`."""
    separation: dict[str, dict[str, float]]
    """Of each of them, unless it is empty: what `RunResults.separation` returns."""

    @classmethod
    def of(cls, results: RunResults) -> Self:
        """Read everything that can be used."""
        sources = read_sources(results)
        known = [each.name for each in results.weightings if results.is_done(each.name)] if sources else []
        weightings = {name: results.weighting(name) for name in known}
        ranking = [name for name, each in weightings.items() if sources and ranks_demonstrations(each, sources)]
        separation = {name: results.separation(name) for name in ranking}
        return cls(
            results=results,
            sources=sources,
            finals={
                each.name: results.evaluation(each.name) for each in results.policies if results.is_done(each.name)
            },
            weightings=weightings,
            diagnostics=results.cluster_diagnostics if results.is_done("clustering") else None,
            ranking=tuple(ranking),
            separation={name: figures for name, figures in separation.items() if figures},
        )

    def title(self, stage: str) -> str:
        """Return what a policy or a weighting is called in tables and figures."""
        titles = {each.name: each.title for each in self.results.policies}
        titles |= {each.name: each.title for each in self.results.weightings}
        return titles[stage]

    def rule(self, weighting: str) -> str:
        """Return how weights follow from scores."""
        stage = next(each for each in self.results.weightings if each.name == weighting)
        return stage.rule(self.results.config)


def finding(found: Findings) -> str:
    """Return what the run found, in two sentences: what is kept, and our return beside those of the other policies."""
    return " ".join(filter(None, (_kept(found), _compared(found))))


def _kept(found: Findings) -> str:
    """Say how many demonstrations the first weighting that ranks them keeps, and of which sources."""
    if not found.ranking or not found.sources:
        return ""
    rows = found.results.verdicts(found.ranking[0]).by_source
    total, kept = sum(row.demonstrations for row in rows), sum(row.kept for row in rows)
    told = f"{kept:,} of {formats.plural(total, 'demonstration')} {'is' if kept == 1 else 'are'} kept"
    named = [f"{row.kept:,} of {row.demonstrations:,} of {row.name}" for row in rows if row.kept]
    if len(rows) == 1 or not named:
        return f"{told}."
    shown = f"{', '.join(named[:MOST_NAMED])}{', …' if len(named) > MOST_NAMED else ''}"
    return f"{told}: {shown}{'; none of the others' if len(named) < len(rows) else ''}."


def _compared(found: Findings) -> str:
    means = {name: final.mean_return for name, final in found.finals.items() if np.isfinite(final.mean_return)}
    first = found.results.policies[0]
    if first.name not in means:
        return ""
    ours = means.pop(first.name)
    compared = []
    for name, other in means.items():
        title, ratio = found.title(name), ours / other if other else 0.0
        # A ratio to a negative return or to one near zero means nothing.
        if other > 0 and 0 < ratio < 100:
            times = f"{ratio:.1f}" if ratio >= 1 else f"{ratio:.2f}"
            compared.append(f"{times} times the return of {title} ({formats.returned(other)})")
        else:
            compared.append(f"against {formats.returned(other)} of {title}")
    listed = " and ".join(filter(None, [", ".join(compared[:-1]), *compared[-1:]]))
    return f"The policy “{first.title}” returns {formats.returned(ours)} on average{', ' if listed else ''}{listed}."


def cards(found: Findings) -> list[Card]:
    """Return the figures that a reader looks for first."""
    results, diagnostics = found.results, found.diagnostics
    seconds, env_steps = sum(results.seconds().values()), sum(results.env_steps().values())
    shown = []
    for policy in results.policies:
        final = found.finals.get(policy.name)
        note = _spread(final) if final else results.states[policy.name].state
        shown.append(
            Card(f"Final return, {policy.title}", formats.returned(final.mean_return if final else None), note)
        )
    shown += [_kept_card(found, name) for name in found.ranking]
    for name, figures in found.separation.items():
        of = f", {found.title(name)}" if len(found.separation) > 1 else ""
        share, unsharpened = formats.percent(figures["share"]), formats.percent(figures["share_power_1"])
        note = "of the transitions that a policy learns from, before and after weighting"
        if unsharpened != share:
            note += f" ({unsharpened} with scores as weights)"
        shown.append(Card(f"Transferable share{of}", share, note, formats.percent(figures["share_before"])))
        note = "1 if all transferable demonstrations rank above all others"
        shown.append(Card(f"AUROC{of}", formats.decimal(figures["auroc"]), note))
    in_use = f"{diagnostics.non_empty_clusters} of {diagnostics.num_clusters} clusters in use" if diagnostics else ""
    if diagnostics and diagnostics.purity is not None:
        shown.append(Card("Purity of clusters", formats.decimal(diagnostics.purity), in_use))
    elif diagnostics:
        stability = f"{formats.percent(diagnostics.label_stability)} of their labels survive another draw"
        shown.append(Card("Clusters", f"{diagnostics.non_empty_clusters}", f"{in_use}; {stability}"))
    steps = formats.count(env_steps) if env_steps else formats.UNKNOWN
    shown.append(Card("Environment steps", steps, "of trainings, and of the episodes by which they are measured"))
    time = formats.duration(seconds) if seconds else formats.UNKNOWN
    shown.append(Card("Time", time, "of all finished stages"))
    return shown


def _kept_card(found: Findings, weighting: str) -> Card:
    """Return how many demonstrations are kept, which a run without marks knows as well."""
    table = found.results.verdicts(weighting)
    rows = table.by_source
    total, kept, undecided = (sum(getattr(row, field) for row in rows) for field in ("demonstrations", "kept", "open"))
    note = f"of {total:,}; {undecided:,} open; as even as {table.effective_number:.0f} of equal weight"
    of = f", {found.title(weighting)}" if len(found.ranking) > 1 else ""
    return Card(f"Demonstrations kept{of}", f"{kept:,}", note)


def _spread(final: Evaluation) -> str:
    episodes = formats.plural(len(final), "episode")
    if not np.isfinite(final.std_return):
        return f"over {episodes}"
    return f"± {formats.spread(final.std_return, final.mean_return)} over {episodes}"


def notes(found: Findings) -> list[Note]:
    """Return the limits of the figures on this page."""
    results = found.results
    told = _unusable(results)
    if found.finals:
        text = (
            f"One seed ({results.config.seed}). Returns of adversarial imitation vary a lot between seeds; a "
            "comparison needs five or more. The spreads on this page are between episodes, not between seeds."
        )
        told.append(Note(text))
    few = [f"{found.title(name)} {len(final)}" for name, final in found.finals.items() if len(final) < FEW_EPISODES]
    if few:
        told.append(Note(f"The mean returns are rough: they are over few episodes ({', '.join(few)})."))
    env_steps = {name: results.policy(name).env_steps for name in found.finals}
    if len(set(env_steps.values())) > 1:
        named = ", ".join(f"{found.title(name)} {formats.count(steps)}" for name, steps in env_steps.items())
        told.append(Note(f"The policies were trained for different numbers of environment steps ({named})."))
    ours = results.policies[0]
    if len(found.finals) > 1 and ours.name in found.finals:
        kept = results.trainings(ours.name).trainings[0]
        goes_on = "Our policy goes on from the imitator of a cluster, where the others begin anew. "
        text = (
            f"{goes_on if kept.goes_on else ''}With all imitators and the readings of their "
            f"scores, ours took {formats.count(results.env_steps_of(ours))} environment steps."
        )
        told.append(Note(text))
    if found.sources and not found.sources.fully_marked:
        text = (
            "Not every source is marked as transferable or not transferable, so neither AUROC nor the transferable "
            "share can be given."
        )
        told.append(Note(text))
    for name, figures in found.separation.items():
        if figures["share"] <= figures["share_before"]:
            text = (
                f"The weighting “{found.title(name)}” does not raise the transferable share: its scores do not favor "
                "transferable demonstrations. The usual cause is a training that is too short."
            )
            told.append(Note(text))
    for name, weighting in found.weightings.items():
        if weighting.history:
            told += [Note(text) for text in (results.verdicts(name).warning,) if text]
    if found.diagnostics and found.diagnostics.label_stability < UNSTABLE_LABELS:
        text = (
            f"The clusters are unstable: the label of a demonstration is that of only "
            f"{formats.percent(found.diagnostics.label_stability)} of its sub-trajectories. Clusters may "
            "split one mode; fewer of them may do."
        )
        told.append(Note(text))
    return told


def _unusable(results: RunResults) -> list[Note]:
    """Name the stages whose results are not on the page, by reason."""
    stages_with: dict[str, list[str]] = {}
    for name, state in results.states.items():
        if state.state != "done":
            stages_with.setdefault(STATES[state.state].format(reason_of(results, name)), []).append(name)
    return [Note(f", {reason}.", f"Missing: {', '.join(stages)}") for reason, stages in stages_with.items()]


def reason_of(results: RunResults, stage: str) -> str:
    """Return why a stage cannot be used, with files named from the run's folder on."""
    return results.states[stage].reason.replace(f"{results.path}/", "")
