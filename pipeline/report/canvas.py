"""What all figures of the report share: their style, dots, axes, and the SVG element that each of them becomes.

Letters: N demonstrations, P points.
"""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray

from oodil.pipeline.report.formats import count
from oodil.pipeline.report.looks import GRID, INK, LINES, MUTED

MOST_AS_VECTORS = 3000
"""With more demonstrations, dots become a bitmap inside the SVG; as vectors they would take megabytes."""

STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "text.color": INK,
    "text.parse_math": False,
    "axes.edgecolor": LINES,
    "axes.labelcolor": MUTED,
    "axes.labelpad": 7,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.titlepad": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": LINES,
    "ytick.color": LINES,
    "xtick.labelcolor": MUTED,
    "ytick.labelcolor": MUTED,
    "xtick.major.size": 3,
    "ytick.major.size": 0,
    "lines.solid_capstyle": "round",
    "figure.facecolor": "none",
    "svg.fonttype": "none",
}


def largest_first(sources: NDArray[np.int32]) -> list[int]:
    """Return the sources in the order of drawing: rare ones last, on top."""
    present, counts = np.unique(sources, return_counts=True)
    return [int(i) for i in present[np.argsort(-counts, kind="stable")]]


def dots(axes: Axes, points: NDArray[np.float64], color: str, marker: str, size: float, total: int) -> None:
    """Draw (P, 2) points of one kind, of a figure that has ``total`` points."""
    axes.scatter(
        points[:, 0], points[:, 1], s=size, c=color, marker=marker, linewidths=0.35, edgecolors="white", zorder=3,
        rasterized=total > MOST_AS_VECTORS,
    )  # fmt: skip


def steps_axis(axes: Axes, bins: int) -> None:
    """Write environment steps in a few characters."""
    axes.xaxis.set_major_locator(MaxNLocator(bins, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: count(value)))


def tick(value: float, _: int) -> str:
    """Return a return as an axis names it."""
    return f"{value:,.0f}" if abs(value) >= 10 else f"{value:g}"


@contextmanager
def drawing(name: str, width: float, height: float) -> Iterator[tuple[Figure, io.StringIO]]:
    """Open a figure in the report's style and a text that holds its SVG element once the block ends.

    Equal content gives equal bytes: the figure's name salts all identifiers, and the SVG has no date.
    """
    with matplotlib.style.context(["default", STYLE | {"svg.hashsalt": name}]):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasSVG(figure)
        svg = io.StringIO()
        yield figure, svg
        drawn = io.StringIO()
        figure.savefig(drawn, format="svg", dpi=200, metadata={"Date": None})
    element = drawn.getvalue()
    element = re.sub(r"<metadata>.*?</metadata>", "", element[element.index("<svg") :], flags=re.DOTALL)
    # Identifiers of groups (axes_1, ...) repeat in every figure, and nothing refers to them.
    svg.write(re.sub(r'(<g) id="[^"]*"', r"\1", element).strip())
