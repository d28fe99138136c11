"""Figures of a table: every seed of every row, learning curves, and a parameter's sweep.

A panel is drawn by one function, for the page by itself, so that panels flow into as many columns as there is room for,
and for the documentation into one sheet. Letters: N seeds, M points of a curve.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

from oodil.pipeline.report.canvas import drawing, steps_axis, tick
from oodil.pipeline.report.looks import INK, MARKERS, MUTED, POLICIES
from oodil.pipeline.report.table.summary import ORACLE, Entry, Measure, Sweep, Table
from oodil.pipeline.statistics import Floats

PANEL, MOST_COLUMNS = 4.4, 2
"""Width of a panel in inches, and the most panels beside each other on a sheet."""
LINE = 0.4
"""Height in inches of a method in a panel of seeds."""


@dataclass(frozen=True)
class Look:
    """How a method is drawn in every figure and legend."""

    color: str
    dashes: Literal["solid", "dashed"]
    marker: str
    glyph: str


def method_looks(table: Table) -> dict[str, Look]:
    """Return one look per method, by name: ours in ink, the oracle dashed, a next marker when all colors are taken."""
    looks = {}
    for i, method in enumerate([table.ours, *(name for name in table.records.methods if name != table.ours)]):
        marker, glyph = MARKERS[i // len(POLICIES) % len(MARKERS)]
        color = POLICIES[i % len(POLICIES)]
        looks[method] = Look(color, "dashed" if method == ORACLE else "solid", marker, glyph)
    return looks


@dataclass(frozen=True)
class Plot:
    """A kind of figure: its panels by name, and what draws one."""

    name: str
    panels: tuple[str, ...]
    height: float
    """Of a panel in inches."""
    draw: Callable[[Axes, str], None]
    named: bool = False
    """Whether its panels name the methods, so that it needs no legend."""

    def each(self) -> Iterator[tuple[str, Markup]]:
        """Yield every panel by itself, without its name."""
        for i, panel in enumerate(self.panels):
            with drawing(f"{self.name}-{i}", PANEL, self.height) as (figure, svg):
                self.draw(figure.subplots(), panel)
            yield panel, Markup(svg.getvalue())

    def sheet(self, table: Table) -> str:
        """Return all panels on one white sheet, with a legend."""
        columns = min(len(self.panels), MOST_COLUMNS)
        rows = -(-len(self.panels) // columns)
        with drawing(self.name, PANEL * columns, 0.3 + (self.height + 0.3) * rows) as (figure, svg):
            figure.set_facecolor("white")
            figure.set_layout_engine("constrained", w_pad=0.12, h_pad=0.1)
            grid = figure.subplots(rows, columns, squeeze=False)
            for axes in grid.flat[len(self.panels) :]:
                axes.set_visible(False)
            for axes, panel in zip(grid.flat, self.panels, strict=False):
                self.draw(axes, panel)
                axes.set_title(panel, fontweight="bold")
            if not self.named:
                _legend(figure, table)
        return svg.getvalue()


def plots(table: Table) -> tuple[Plot, ...]:
    """Return the figures of a table: its seeds, or the sweep that its rows are, and the learning curves."""
    looks, records = method_looks(table), table.records
    made = []
    if table.sweep and any(entry.found for entry in table.entries.values()):
        sweep = table.sweep
        made.append(Plot("sweep", (table.measure.title,), 2.9, lambda axes, _: _sweep(axes, table, sweep, looks)))
        if any(table.by_seed(row, table.ours, "clusters_used") for row in records.rows):
            made.append(Plot("clusters", ("clusters in use",), 1.7, lambda axes, _: _clusters(axes, table, sweep)))
    elif any(entry.found for entry in table.entries.values()):
        rows = tuple(row for row in records.rows if any(table.entries[row, m].found for m in records.methods))
        height = 0.5 + LINE * len(records.methods)
        made.append(Plot("seeds", rows, height, lambda axes, row: _seeds(axes, table, row, looks), named=True))
    rows = tuple(dict.fromkeys(cell.row for cell in records.cells if len(cell.curve.env_steps) > 1))
    if rows:
        order = tuple(row for row in records.rows if row in rows)
        made.append(Plot("curves", order, 2.5, lambda axes, row: _curves(axes, table, row, looks)))
    return tuple(made)


def _seeds(axes: Axes, table: Table, row: str, looks: dict[str, Look]) -> None:
    """Draw a line for each method: a point per seed, the mean, the interval or deviation, the published figure."""
    low, high = _reach(table)
    for i, method in enumerate(table.records.methods):
        entry, look = table.entries[row, method], looks[method]
        title = table.records.methods[method]
        axes.annotate(
            title, (0, -i), xycoords=("axes fraction", "data"), xytext=(0, 10), textcoords="offset points", va="center",
            color=look.color, fontweight="bold" if method == table.ours else "normal", annotation_clip=False,
        )  # fmt: skip
        axes.axhline(-i, color=MUTED, linewidth=0.4, alpha=0.5, zorder=0)
        if entry.published is not None:
            axes.plot(entry.published, -i, "D", markersize=6, markerfacecolor="none", color=MUTED, zorder=2)
        if entry.found is None:
            continue
        values = np.array(list(entry.by_seed.values()))
        axes.hlines(-i, *_spread(entry), color=look.color, linewidth=4, alpha=0.25, zorder=1)
        axes.scatter(
            values, np.full(len(values), -i), s=24, c=look.color, marker=look.marker, edgecolors="#ffffff",
            linewidths=0.5, zorder=4,
        )  # fmt: skip
        axes.vlines(entry.found.mean, -i - 0.22, -i + 0.22, color=look.color, linewidth=1.8, zorder=3)
        axes.annotate(
            table.measure.shown(entry.found.mean), (1, -i), xycoords=("axes fraction", "data"), xytext=(0, 10),
            textcoords="offset points", ha="right", va="center", color=look.color, annotation_clip=False,
        )  # fmt: skip
    axes.set(xlim=(low, high), ylim=(0.45 - len(table.records.methods), 0.75), yticks=())
    axes.spines["left"].set_visible(False)
    axes.grid(axis="x")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(_ticks(table.measure))


def _spread(entry: Entry) -> tuple[float, float]:
    """Return the interval of the interquartile mean, or with few seeds the deviation around the mean."""
    assert entry.found is not None
    deviation = np.nan_to_num(entry.found.deviation)
    return entry.found.interval or (entry.found.mean - deviation, entry.found.mean + deviation)


def _reach(table: Table) -> tuple[float, float]:
    """Return the limits of an axis for every figure of the table, ours and published."""
    entries = table.entries.values()
    values = [value for entry in entries for value in entry.by_seed.values()]
    values += [entry.published for entry in entries if entry.published is not None]
    values += [limit for entry in entries if entry.found for limit in _spread(entry)]
    margin = 0.04 * (max(values) - min(values)) or abs(values[0]) or 1
    return min(values) - margin, max(values) + margin


def _ticks(measure: Measure) -> FuncFormatter:
    if measure.title == "environment steps" or "share" in measure.title:
        return FuncFormatter(lambda value, _: measure.shown(value))
    return FuncFormatter(tick)


def _curves(axes: Axes, table: Table, row: str, looks: dict[str, Look]) -> None:
    """Draw the mean return over the seeds of each method, with a band of one standard deviation over them."""
    for method in reversed([table.ours, *(each for each in table.records.methods if each != table.ours)]):
        found = curve_over_seeds(table, row, method)
        if found is None:
            continue
        env_steps, returns = found
        mean, look = returns.mean(axis=0), looks[method]
        if len(returns) > 1:
            deviation = returns.std(axis=0, ddof=1)
            axes.fill_between(env_steps, mean - deviation, mean + deviation, color=look.color, alpha=0.15, linewidth=0)
        axes.plot(
            env_steps, mean, color=look.color, linestyle=look.dashes, linewidth=2.2 if method == table.ours else 1.5
        )
    axes.set_xlim(left=0)
    steps_axis(axes, 5)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_formatter(FuncFormatter(tick))
    axes.set_xlabel("environment steps")
    axes.set_ylabel("return")


def curve_over_seeds(table: Table, row: str, method: str) -> tuple[Floats, Floats] | None:
    """Return the steps (M,) at which any seed was evaluated and the returns (N, M) there, between points on a line.

    None where no seed has two finite points, or the seeds have no steps in common.
    """
    curves = []
    for cell in table.records.cells:
        points = zip(cell.curve.env_steps, cell.curve.mean_return, strict=True)
        known = np.array([point for point in points if point[1] is not None], dtype=np.float64)
        if (cell.row, cell.method) == (row, method) and len(known) > 1:
            curves.append(known.T)
    if not curves:
        return None
    first, last = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    steps = np.unique(np.concatenate([steps for steps, _ in curves]))
    steps = steps[(steps >= first) & (steps <= last)]
    return (steps, np.array([np.interp(steps, *curve) for curve in curves])) if len(steps) > 1 else None


def _sweep(axes: Axes, table: Table, sweep: Sweep, looks: dict[str, Look]) -> None:
    """Draw each method over the values: a point per seed, a line through the means, hollow what was published."""
    for method, look in reversed(looks.items()):
        entries = [(sweep.values[row], table.entries[row, method]) for row in table.records.rows]
        points = [(x, value) for x, entry in entries for value in entry.by_seed.values()]
        means = sorted((x, entry.found.mean) for x, entry in entries if entry.found)
        published = sorted((x, entry.published) for x, entry in entries if entry.published is not None)
        if published:
            axes.plot(
                *zip(*published, strict=True), "D", markerfacecolor="none", color=look.color, linestyle=(0, (1, 1.5)),
                linewidth=1, markersize=5, alpha=0.7,
            )  # fmt: skip
        if points:
            axes.plot(*zip(*means, strict=True), color=look.color, linestyle=look.dashes, linewidth=1.8)
            x, y = zip(*points, strict=True)
            axes.scatter(x, y, s=18, c=look.color, marker=look.marker, edgecolors="#ffffff", linewidths=0.4, zorder=3)
    _values_axis(axes, sweep)
    low, high = axes.get_ylim()
    axes.set_ylim(min(0, low), high)
    axes.yaxis.set_major_formatter(_ticks(table.measure))
    axes.set_ylabel(table.measure.title)


def _clusters(axes: Axes, table: Table, sweep: Sweep) -> None:
    """Draw how many clusters are not empty, a point per seed."""
    for row, x in sweep.values.items():
        values = list(table.by_seed(row, table.ours, "clusters_used").values())
        axes.scatter([x] * len(values), values, s=18, c=INK, edgecolors="#ffffff", linewidths=0.4, zorder=3)
    _values_axis(axes, sweep)
    axes.set_ylim(0)
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.set_ylabel("clusters in use")


def _values_axis(axes: Axes, sweep: Sweep) -> None:
    if sweep.logarithmic:
        axes.set_xscale("log")
    values = sorted(sweep.values.values())
    axes.set_xticks(values, [f"{value:g}" for value in values])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel(sweep.key)


def _legend(figure: Figure, table: Table) -> None:
    handles = [
        Line2D([], [], color=look.color, linestyle=look.dashes, marker=look.marker, markersize=4)
        for look in method_looks(table).values()
    ]
    titles = [table.records.methods[method] for method in method_looks(table)]
    figure.legend(handles, titles, loc="outside lower left", ncols=3, frameon=False)
