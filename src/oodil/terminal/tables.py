"""What a run and its demonstrations have come to, as tables."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from oodil.pipeline.runs import RunResults, shown_return
from oodil.pipeline.verdicts import MEANING, VerdictTable
from oodil.terminal.words import duration

if TYPE_CHECKING:
    from oodil.pipeline.data import Demonstrations
    from oodil.pipeline.results import Transferability
    from oodil.pipeline.scoring import Scored

MOST_ROWS = 50
"""Demonstrations in a table; a file takes the others."""


def print_summary(results: RunResults, report: Path) -> None:
    """Print the results known so far and where the report is."""
    console = Console()
    table = Table(show_header=False, box=None, padding=(0, 2))
    for label, figure in _summary_rows(results):
        table.add_row(label, figure)
    console.print()
    console.print(table)
    _print_verdicts(console, results)
    console.print(f"\nreport: {report}", highlight=False, soft_wrap=True)


def _summary_rows(results: RunResults) -> Iterator[tuple[str, str]]:
    """Yield what is known of each policy, of each weighting, and of the whole run."""
    found = results.summary()
    for policy in results.policies:
        value = found.get("policies", {}).get(policy.name, {}).get("mean_return")
        if value is not None:
            yield f"final return, {policy.title}", shown_return(value)
    if "purity" in found:
        yield "cluster purity", f"{found['purity']:.3f}"
    for weighting in results.weightings:
        figures = found.get("weightings", {}).get(weighting.name)
        if figures:
            yield f"AUROC, {weighting.title}", f"{figures['auroc']:.3f}"
            shares = f"{figures['share_before']:.3f} -> {figures['share']:.3f}"
            yield f"transferable share of the sampling mass, {weighting.title}", shares
    if "reproducibility" in found:
        sources = [each["name"] for each in found["reproducibility"]["sources"] if each["reproducible"]]
        everything = "everything" if found["reproducibility"]["everything"] else ", ".join(sources) or "nothing"
        yield "the imitator's simulator can follow", everything
    if "env_steps" in found:
        yield "environment steps", f"{found['env_steps']:,}"
    if "seconds" in found:
        yield "time", duration(found["seconds"])


def print_status(results: RunResults) -> None:
    """Print where the stages of a run stand, and its results."""
    console = Console()
    table = Table("stage", "state", box=None, padding=(0, 2))
    table.add_column("seconds", justify="right")
    table.add_column("sha256 or reason")
    seconds = results.seconds()
    for name, state in results.states.items():
        took = f"{seconds[name]:,.1f}" if name in seconds else ""
        table.add_row(name, state.state, took, escape(state.artifact.sha256[:12] if state.artifact else state.reason))
    console.print(f"{results.config.name}, seed {results.config.seed}  ({results.path})", highlight=False)
    console.print(table)
    for label, figure in _summary_rows(results):
        console.print(f"  {label}: {figure}", highlight=False)
    _print_verdicts(console, results)


def _print_verdicts(console: Console, results: RunResults) -> None:
    """Print what every weighting that trains imitators says of each source and each cluster."""
    for weighting in results.weightings:
        usable = results.is_done(weighting.name) and results.is_done("demonstrations")
        if not usable or not results.weighting(weighting.name).history:
            continue
        found = results.verdicts(weighting.name)
        console.print(f"\nTransferability ({escape(weighting.title)}). {MEANING}.", highlight=False)
        console.print(_verdict_table(found))
        told = (
            f"Kept: the whole interval reaches {found.threshold:.3f}; open: a part of it does. Drawn: share of the "
            "transitions that are drawn, before and after weighting; it is as even as that of "
            f"{found.effective_number:.0f} equal demonstrations."
        )
        console.print(told, highlight=False)
        if found.warning:
            console.print(f"[yellow]{escape(found.warning)}[/]", highlight=False)
    if results.is_done("clustering") and results.suggestion:
        used = results.cluster_diagnostics.non_empty_clusters
        console.print(f"Clusters in use: {used}. {results.suggestion.text}", highlight=False)


def _verdict_table(found: VerdictTable) -> Table:
    table = Table(box=None, padding=(0, 1), pad_edge=False)
    table.add_column("source", max_width=20, overflow="ellipsis", no_wrap=True)
    unlike = any(row.unlike for row in found.by_source)
    for name in ("n", "kept", "open", *(["unlike"] if unlike else []), "score and interval", "drawn"):
        table.add_column(name, justify="right", no_wrap=True)
    for title, rows in (("", found.by_source), ("[bold]cluster[/]", found.by_cluster)):
        if title:
            table.add_row(title)
        for row in rows:
            counts = (str(each) for each in (row.demonstrations, row.kept, row.open, *([row.unlike] if unlike else [])))
            score = escape(_score(row.score, row.low, row.high))
            table.add_row(escape(row.name), *counts, score, f"{row.share_before:.1%} -> {row.share:.1%}")
    return table


def _score(score: float, low: float, high: float) -> str:
    """Return a score with its interval; a dash where there is none."""
    return f"{score:.3f} [{low:.3f}, {high:.3f}]" if np.isfinite(score) else "-"


def print_scores(results: RunResults, scored: "Scored") -> None:
    """Print what each weighting says of demonstrations that came later, by source and one by one."""
    console, titles = Console(), {each.name: each.title for each in results.weightings}
    for name, found in scored.found.items():
        console.print(f"\n{escape(titles[name])}: kept from a score of {found.threshold:.3f}", highlight=False)
        console.print(_verdict_table(VerdictTable.of(found, scored.demonstrations)))
        console.print(_demonstration_table(found, scored.demonstrations))
        if len(scored.demonstrations) > MOST_ROWS:
            console.print(f"... and {len(scored.demonstrations) - MOST_ROWS} more; --output FILE.csv has all")
    for name, reason in scored.refused.items():
        console.print(f"{escape(titles[name])}: {escape(reason)}", highlight=False, soft_wrap=True)


def _demonstration_table(found: "Transferability", demonstrations: "Demonstrations") -> Table:
    table = Table(box=None, padding=(0, 1), pad_edge=False)
    table.add_column("demonstration", justify="right")
    table.add_column("source", max_width=20, overflow="ellipsis", no_wrap=True)
    for name in ("cluster", "score and interval", "verdict"):
        table.add_column(name, justify="right", no_wrap=True)
    verdicts = found.verdicts
    for n in range(min(len(demonstrations), MOST_ROWS)):
        source = escape(demonstrations.source_labels[demonstrations.sources[n]])
        cluster = str(found.clusters[n]) if found.clusters[n] >= 0 else ""
        score = escape(_score(float(found.scores[n]), *found.intervals[n]))
        table.add_row(str(n), source, cluster, score, str(verdicts[n]))
    return table


def print_demonstrations(path: Path, demonstrations: "Demonstrations", environment: str) -> None:
    """Print what a set of demonstrations contains, by source."""
    console = Console()
    lengths, counts = demonstrations.lengths, np.bincount(demonstrations.sources)
    console.print(
        f"{path}: {len(demonstrations)} demonstrations, {lengths.sum():,} states of {demonstrations.observation_dim} "
        f"dimensions, environment {environment or 'not stated'}",
        highlight=False,
        soft_wrap=True,
    )
    table = Table("source", "count", "states (min - max)", "return in its own dynamics", box=None, padding=(0, 2))
    for i, label in enumerate(demonstrations.source_labels):
        mine = demonstrations.sources == i
        if mine.any():
            returns = demonstrations.returns[mine]
            shown = f"{returns.mean():,.0f} ± {returns.std():,.0f}" if np.isfinite(returns).all() else "not recorded"
            table.add_row(label, str(counts[i]), f"{lengths[mine].min()} - {lengths[mine].max()}", shown)
    console.print(table)


def print_bench(environment: str, results: dict[int, dict[str, float]]) -> None:
    """Print environment steps per second by number of workers, and which is best."""
    best = max(results, key=lambda workers: results[workers]["steps_per_s"])
    slowest = min(figures["steps_per_s"] for figures in results.values())
    table = Table("workers", "steps per second", "times the slowest", "", box=None, padding=(0, 2))
    for workers, figures in results.items():
        rate = figures["steps_per_s"]
        name = f"{workers} (inline)" if workers == 0 else str(workers)
        table.add_row(name, f"{rate:,.0f}", f"{rate / slowest:.2f}", "◀ --workers" if workers == best else "")
    console = Console()
    console.print(f"{environment}: one learner and its rollout workers, {os.cpu_count()} cores", highlight=False)
    console.print(table)
