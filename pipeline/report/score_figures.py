"""Figures of the scores, each one SVG element: what was read, and how the trainings came to it.

Letters: N demonstrations, K clusters, G columns.
"""

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from numpy.typing import NDArray

from oodil.pipeline.report.canvas import MOST_AS_VECTORS, drawing, largest_first, steps_axis
from oodil.pipeline.report.looks import INK, MUTED, Look
from oodil.pipeline.results import Transferability

MOST_COUNTED, MOST_NAMED = 11, 30
"""With more columns in all, there is no room for their counts, and then none for the numbers of clusters."""
LEAST_SIZE, SMALL = 22, 8
"""Of a mark that is kept or open: in a crowded column, few of them would be lost; and of one that is not kept."""
FILLED = {"not kept": True, "open": False, "kept": True}
"""By verdict, whether a mark is filled; in the order of drawing."""


def transferability(found: Transferability, sources: NDArray[np.int32], looks: list[Look]) -> Markup:
    """Draw every score with its interval, in a column for each source (N,) and, if there are any, for each cluster.

    Columns are equally wide however many demonstrations they hold, the best first; within a column, so are scores.
    """
    groupings = [("by source", "", sources)]
    if (found.clusters >= 0).any():
        groupings.append(("by cluster", "cluster ", found.clusters))
    columns = [len(np.unique(groups)) for *_, groups in groupings]
    with drawing("transferability", 11, 3.6) as (figure, svg):
        panels = figure.subplots(1, len(groupings), sharey=True, squeeze=False, width_ratios=columns)[0]
        for axes, (title, prefix, groups) in zip(panels, groupings, strict=True):
            axes.set_title(title)
            _columns(axes, found, groups, prefix, sources, looks, sum(columns))
        top = max(float(found.intervals.max()), float(found.scores.max()))
        _score_axis(panels[0], top, found.threshold)
        for axes in panels[1:]:
            _threshold(axes, found.threshold)
        panels[-1].annotate(
            f"kept from {found.threshold:.3f}", (1.0, found.threshold), xytext=(0, 3), textcoords="offset points",
            xycoords=panels[-1].get_yaxis_transform(), ha="right", va="bottom", fontsize=8, color=INK,
            bbox={"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 1}, zorder=4,
        )  # fmt: skip
        panels[0].set_ylabel("transferability")
    return Markup(svg.getvalue())


def _columns(
    axes: Axes,
    found: Transferability,
    groups: NDArray[np.int32],
    prefix: str,
    sources: NDArray[np.int32],
    looks: list[Look],
    total: int,
) -> None:
    """Draw a column for each of the (N,) groups, with a line at its mean and below it how many are kept.

    ``total`` is the number of columns in all panels.
    """
    present = sorted(np.unique(groups).tolist(), key=lambda group: -found.scores[groups == group].mean())
    x, size, verdicts, below = np.empty(len(groups)), np.empty(len(groups)), found.verdicts, []
    for column, group in enumerate(present):
        mine = np.flatnonzero(groups == group)
        ranked = mine[np.argsort(-found.scores[mine], kind="stable")]
        x[ranked] = column + 0.8 * ((np.arange(len(mine)) + 0.5) / len(mine) - 0.5)
        size[mine] = np.clip(1000 / len(mine), 7, 36)
        mean = found.scores[mine].mean()
        axes.hlines(mean, column - 0.44, column + 0.44, color=INK, linewidth=1.2, zorder=2)
        name = f"{prefix}{group}\n" if prefix else ""
        count = f"{name}{(verdicts[mine] == 'kept').sum()} of {len(mine)} kept"
        below.append(count if total <= MOST_COUNTED else str(group) if prefix and total <= MOST_NAMED else "")
    axes.set_xticks(range(len(present)), below)
    axes.set_xlim(-0.55, len(present) - 0.45)
    axes.tick_params(axis="x", length=0)
    lines = np.minimum(1.2, size / 20)
    size = np.where(verdicts == "not kept", np.minimum(size, SMALL), np.maximum(size, LEAST_SIZE))
    bitmap = len(groups) > MOST_AS_VECTORS
    for i in largest_first(sources):
        for verdict, filled in FILLED.items():
            mine = (sources == i) & (verdicts == verdict)
            color, marker = looks[i].color, looks[i].marker
            low, high = found.intervals[mine].T
            axes.vlines(
                x[mine],
                low,
                high,
                color=color,
                linewidth=lines[mine],
                alpha=0.4,
                rasterized=bitmap,
            )
            axes.scatter(
                x[mine], found.scores[mine], s=size[mine], marker=marker, zorder=3, rasterized=bitmap,
                facecolors=color if filled else "white", edgecolors="white" if filled else color,
                linewidths=0.35 if filled else 1.2,
            )  # fmt: skip


def convergence(found: Transferability, colors: dict[int, str]) -> Markup:
    """Draw each cluster in a panel: 2 (1 - D) of its training's discriminator, and as a mark what was read at the end.

    The line is the mean over the cluster's demonstrations, the band and the bar are from the 10 to the 90 % quantile.
    """
    histories = found.history
    curves = {k: np.minimum(1, 2 * np.exp(-np.logaddexp(0, seen.logits))) for k, seen in histories.items()}
    columns = min(len(histories), 5)
    rows = -(-len(histories) // columns)
    highest = max(float(found.scores.max()), *(float(scores.max()) for scores in curves.values()))
    with drawing("convergence", 11, 0.75 + 1.75 * rows) as (figure, svg):
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False, gridspec_kw={"wspace": 0.07})
        for axes in panels.flat[len(histories) :]:
            axes.set_visible(False)
        for axes in panels.flat[: len(histories)][-columns:]:
            axes.tick_params(labelbottom=True)
        for axes, (k, scores) in zip(panels.flat, curves.items(), strict=False):
            env_steps = histories[k].env_steps
            low, high = np.quantile(scores, (0.1, 0.9), axis=1)
            axes.fill_between(env_steps, low, high, color=colors[k], alpha=0.22, linewidth=0)
            axes.plot(env_steps, scores.mean(axis=1), color=colors[k], linewidth=1.8)
            read = found.scores[histories[k].demonstrations]
            low, high = np.quantile(read, (0.1, 0.9))
            axes.vlines(env_steps[-1], low, high, color=INK, linewidth=1.2)
            axes.plot(env_steps[-1], read.mean(), marker="D", markersize=5, color=INK, clip_on=False)
            axes.set_title(f"cluster {k}", fontweight="bold")
            axes.set_title(f"N = {scores.shape[1]}", loc="right", fontsize=7.5, color=MUTED)
            _score_axis(axes, highest, found.threshold)
            steps_axis(axes, 4)
        figure.supxlabel("environment steps of the cluster's imitator", fontsize=8.5, color=MUTED)
        panels[0, 0].set_ylabel("2 (1 − D)")
    return Markup(svg.getvalue())


def _score_axis(axes: Axes, highest: float, threshold: float) -> None:
    """Let the axis end at what there is: scores far below 1 would lie at the bottom of an empty plane."""
    axes.set_ylim(0, min(1.02, 1.1 * max(highest, threshold)) or 1)
    _threshold(axes, threshold)


def _threshold(axes: Axes, threshold: float) -> None:
    axes.axhline(threshold, color=INK, linewidth=0.9, linestyle=(0, (4, 3)), zorder=1)
