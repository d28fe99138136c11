"""The paths of demonstrations in the plane, shaded by what a weighting makes of them, as the paper shows Driving.

Letters: N demonstrations.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator, PercentFormatter
from numpy.typing import NDArray

from oodil.pipeline.config import EnvironmentConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments.driving import DrivingEnv
from oodil.pipeline.environments.driving_world import GOAL, HEIGHT, WIDTH, Box, Layout, positions
from oodil.pipeline.report.canvas import drawing
from oodil.pipeline.report.looks import MUTED, NOT_TRANSFERABLE, TRANSFERABLE, Look

SHADES = LinearSegmentedColormap.from_list("shades", ("#d5dbe2", "#6f9bd1", "#0b2a5b"))
"""From weightless to the heaviest."""
LIGHT = "#fdfdfd"
"""Stays light on dark paper, as the shades need it."""
MOST_COLUMNS = 4


def world_of(environment: EnvironmentConfig) -> Layout | None:
    """Return the plane that an imitator drives in; None for an environment without one."""
    if not environment.id.endswith("oodil/Driving-v0"):
        return None
    keywords: Mapping[str, Any] = environment.dynamics
    return DrivingEnv(**keywords).layout


def paths(demonstrations: Demonstrations, weights: NDArray[np.float64], looks: list[Look], world: Layout) -> Markup:
    """Draw the paths of each source in a panel, over the imitator's obstacles, shaded by (N,) weights.

    The heaviest are on top. A panel's title is the source's mark, as in the legend.
    """
    present = np.unique(demonstrations.sources).tolist()
    columns = min(len(present), MOST_COLUMNS)
    rows = -(-len(present) // columns)
    lines = np.split(positions(demonstrations.observations), demonstrations.offsets[1:-1])
    depth = Normalize(0, weights.max())
    with drawing("paths", 11, 0.3 + rows * min(8.6 / columns, 4.0)) as (figure, svg):
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes in panels.flat[len(present) :]:
            axes.set_visible(False)
        for axes, source in zip(panels.flat, present, strict=False):
            mine = np.flatnonzero(demonstrations.sources == source)
            _panel(axes, [lines[n] for n in mine], weights[mine], depth, world)
            look = looks[source]
            axes.set_title(f"{look.glyph} {len(mine)} paths", color=look.color, fontweight="bold")
        bar = figure.colorbar(
            ScalarMappable(depth, SHADES), ax=panels, label="weight", pad=0.01, shrink=0.8, aspect=30,
            format=PercentFormatter(1), ticks=MaxNLocator(4),
        )  # fmt: skip
        bar.outline.set_visible(False)
    return Markup(svg.getvalue())


def sheet(demonstrations: Demonstrations, weightings: Mapping[str, NDArray[np.float64]], world: Layout) -> str:
    """Draw the same on one white sheet, a row for each of several (N,) weightings and a column for each source."""
    lines = np.split(positions(demonstrations.observations), demonstrations.offsets[1:-1])
    present = np.unique(demonstrations.sources).tolist()
    with drawing("sheet", 3.2 * len(present), 0.3 + 2.75 * len(weightings)) as (figure, svg):
        figure.set_facecolor("white")
        grid = figure.subplots(len(weightings), len(present), squeeze=False)
        for row, (title, weights) in zip(grid, weightings.items(), strict=True):
            row[0].set_ylabel(title, fontweight="bold", fontsize=11)
            for axes, source in zip(row, present, strict=True):
                mine = np.flatnonzero(demonstrations.sources == source)
                _panel(axes, [lines[n] for n in mine], weights[mine], Normalize(0, weights.max()), world)
        for axes, source in zip(grid[0], present, strict=True):
            axes.set_title(demonstrations.source_labels[source], fontweight="bold")
    return svg.getvalue()


def _panel(
    axes: Axes, lines: list[NDArray[np.float64]], weights: NDArray[np.float64], depth: Normalize, world: Layout
) -> None:
    """Draw paths over the plane, shaded by their weights."""
    _plane(axes, world)
    order = np.argsort(weights, kind="stable")
    drawn = LineCollection(
        [lines[n] for n in order], array=weights[order], cmap=SHADES, norm=depth, linewidths=0.9, rasterized=True
    )
    axes.add_collection(drawn)


def _plane(axes: Axes, world: Layout) -> None:
    """Draw the border, the strip to be reached and the obstacles."""
    axes.set(xlim=(0, WIDTH), ylim=(0, HEIGHT), aspect="equal", xticks=[], yticks=[], facecolor=LIGHT)
    axes.grid(False)
    axes.spines[:].set_visible(True)
    axes.spines[:].set_color(MUTED)
    _box(axes, GOAL, TRANSFERABLE[2], 0.55)
    for obstacle in world.obstacles:
        _box(axes, obstacle, NOT_TRANSFERABLE[0], 0.6)


def _box(axes: Axes, box: Box, color: str, alpha: float) -> None:
    corner = box.left, box.y - box.depth / 2
    axes.add_patch(Rectangle(corner, box.width, box.depth, color=color, alpha=alpha, linewidth=0, zorder=3))
