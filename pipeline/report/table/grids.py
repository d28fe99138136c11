"""The tables below the table, the same on the page and in Markdown: head, rows of text, and what they mean."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from oodil.pipeline.report import formats
from oodil.pipeline.report.table.summary import MEASURES, ORACLE, Measure, Table
from oodil.pipeline.statistics import COVERED, ENOUGH_SEEDS

ASIDE = "mean_return", "share_reached", "auroc", "effective_number", "purity", "clusters_used", "distance", "env_steps"
"""What stands in the table of further figures, beside the shares, unless it is what the table itself shows."""


@dataclass(frozen=True)
class Grid:
    """A table of text whose first column names its rows."""

    title: str
    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def grids(table: Table) -> tuple[Grid, ...]:
    """Return the tables of further figures, of comparisons and of sources that there is something to say in."""
    made = (_figures(table), _normalized(table), _improvements(table), _sources(table))
    return tuple(grid for grid in made if grid.rows)


def _figures(table: Table) -> Grid:
    records = table.records
    columns = {MEASURES[name].title: name for name in ASIDE if name != records.figure}
    share = "transferable share"
    found = {
        (row, method): {title: _over_seeds(table, row, method, name) for title, name in columns.items()}
        | {share: _shares(table, row, method)}
        for row in records.rows
        for method in records.methods
    }
    order = list(columns)
    order.insert(order.index("effective number") if "effective number" in order else len(order), share)
    used = [title for title in order if any(cells[title] for cells in found.values())]
    return Grid(
        title="Further figures",
        caption="Means over seeds and, in parentheses, the lowest and the highest of a seed. Transferable share: of "
        "the sampling mass, before weighting and after it; effective number: as many demonstrations of equal weight "
        "would be as even; environment steps: of all that a column needs.",
        head=("", "method", *used),
        rows=tuple(
            (row, records.methods[method], *(cells[title] or formats.UNKNOWN for title in used))
            for (row, method), cells in found.items()
            if any(cells.values())
        ),
    )


def _over_seeds(table: Table, row: str, method: str, name: str) -> str:
    values = list(table.by_seed(row, method, name).values())
    return spanned(values, MEASURES[name]) if values else ""


def _shares(table: Table, row: str, method: str) -> str:
    before, after = (table.by_seed(row, method, name) for name in ("share_before", "share_after"))
    shown = MEASURES["share_after"]
    if not before or not after:
        return ""
    return f"{shown.shown(float(np.mean(list(before.values()))))} → {spanned(list(after.values()), shown)}"


def spanned(values: list[float], measure: Measure) -> str:
    """Return a mean, and the lowest and the highest value where they are written differently."""
    mean, low, high = (measure.shown(float(value)) for value in (np.mean(values), min(values), max(values)))
    return mean if low == high else f"{mean} ({low} to {high})"


def _normalized(table: Table) -> Grid:
    records = table.records
    rows = []
    for row in records.rows:
        scores = [table.normalized(row, method) for method in records.methods]
        if any(each is not None for each in scores):
            random, expert = (
                formats.returned(known.get(row)) for known in (records.random_return, records.expert_return)
            )
            cells = [formats.UNKNOWN if each is None else f"{np.mean(list(each.values())):.1f}" for each in scores]
            rows.append((row, random, expert, *cells))
    if rows and any(table.overall(method) for method in records.methods):
        rows.append(("all rows, interquartile mean", "", "", *(_overall(table, method) for method in records.methods)))
    return Grid(
        title="Normalized score",
        caption="100 (return - random) / (expert - random), as in ODRL: a random policy has 0, an expert trained in "
        f"the target's own dynamics 100. Means over seeds. The interval of all rows covers {COVERED:.0%} and needs "
        f"{ENOUGH_SEEDS} seeds (bootstrap, stratified by row).",
        head=("", "random", "expert", *records.methods.values()),
        rows=tuple(rows),
    )


def _overall(table: Table, method: str) -> str:
    found = table.overall(method)
    if found is None:
        return formats.UNKNOWN
    mean, limits = found
    return f"{mean:.1f} ({limits[0]:.1f} to {limits[1]:.1f})" if limits else f"{mean:.1f}"


def _improvements(table: Table) -> Grid:
    records = table.records
    others = [method for method in records.methods if method != table.ours]
    rows = []
    for row in records.rows:
        found = [table.improvement(row, method) for method in others]
        if any(each is not None for each in found):
            rows.append((row, *(formats.decimal(each, 2) for each in found)))
    return Grid(
        title="Probability of improvement",
        caption=f"How often a seed of “{records.methods[table.ours]}” is better than one of the other method; ties "
        f"count half. Only where both have {ENOUGH_SEEDS} seeds.",
        head=("", *(f"over {records.methods[method]}" for method in others)),
        rows=tuple(rows),
    )


def _sources(table: Table) -> Grid:
    records = table.records
    scoring = [
        method
        for method in records.methods
        if any(score is not None for row in records.rows for _, score, _ in table.sources(row, method))
    ]
    rows: list[tuple[str, ...]] = []
    for row in records.rows:
        found = {method: {label: rest for label, *rest in table.sources(row, method)} for method in scoring}
        for source in dict.fromkeys(label for each in found.values() for label in each):
            rows.append((row, source, *(_score(*found[method].get(source, (None, None))) for method in scoring)))
    return Grid(
        title="Scores by source",
        caption="The mean score of a source's demonstrations and, after the colon, their mean weight, over seeds.",
        head=("", "source", *(records.methods[method] for method in scoring)),
        rows=tuple(rows),
    )


def _score(score: float | None, weight: float | None) -> str:
    shown = formats.decimal(score)
    return shown if weight is None else f"{shown} : {weight:.2f}"


def notes(table: Table) -> Iterator[str]:
    """Yield what failed and what is not there yet."""
    records = table.records
    for failure in records.failed:
        what = f"{records.methods.get(failure.method, failure.method)}, " if failure.method else ""
        yield f"Failed: {failure.row}, {what}seed {failure.seed}: {failure.reason}"
    seeds: dict[tuple[str, str], list[int]] = defaultdict(list)
    for row, method, seed in records.missing:
        seeds[row, method].append(seed)
    methods: dict[tuple[str, tuple[int, ...]], list[str]] = defaultdict(list)
    for (row, method), each in seeds.items():
        methods[row, tuple(sorted(each))].append(method)
    rows: dict[tuple[tuple[str, ...], tuple[int, ...]], list[str]] = defaultdict(list)
    for (row, lacking), columns in methods.items():
        rows[tuple(columns), lacking].append(row)
    for (named, lacking), alike in rows.items():
        titles = ", ".join(records.methods[method] for method in named)
        what = "all methods" if len(named) == len(records.methods) > 1 else titles
        listed = f"seed{'s' * (len(lacking) > 1)} {', '.join(map(str, lacking))}"
        yield f"Not there yet: {', '.join(alike)}; {what}; {listed}"


def findings(table: Table) -> Iterator[str]:
    """Yield how ours compares with the paper and with the other methods, row by row."""
    records, title = table.records, table.records.methods[table.ours]
    ours = {row: table.entries[row, table.ours] for row in records.rows}
    against = [entry for entry in ours.values() if entry.found and entry.published is not None]
    if against:
        below = [entry for entry in against if table.marked[entry.row, table.ours] == "published"]
        yield _counted(f"“{title}” is at or above the paper", len(against), [entry.row for entry in below], "Below it")
    others = [method for method in records.methods if method not in (table.ours, ORACLE)]
    compared = {
        row: methods
        for row in records.rows
        if ours[row].is_complete and (methods := [name for name in others if table.entries[row, name].is_complete])
    }
    if compared:
        close = {
            row: [records.methods[name] for name in methods if not _beyond(table, row, name)]
            for row, methods in compared.items()
        }
        what = f"“{title}” is better than every other complete column but the oracle"
        exceptions = [f"{row} ({', '.join(each)})" for row, each in close.items() if each]
        yield _counted(f"{what} by more than the deviation over seeds", len(compared), exceptions, "Not")


def _beyond(table: Table, row: str, method: str) -> bool:
    """Return whether ours is better than a method by more than the larger of their two deviations."""
    ours, theirs = (table.entries[row, name].found for name in (table.ours, method))
    assert ours is not None and theirs is not None, "only what is complete is compared"
    better = ours.mean - theirs.mean if table.measure.higher_is_better else theirs.mean - ours.mean
    return better > max(ours.deviation, theirs.deviation)


def _counted(what: str, total: int, exceptions: list[str], lead: str) -> str:
    said = f"{what} in {total - len(exceptions)} of {total} rows."
    return f"{said} {lead}: {', '.join(exceptions)}." if exceptions else said
