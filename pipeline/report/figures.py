"""The figures of the report, each one SVG element. Labels of sources stand in legends on the page, not in figures.

A source has the same color and marker in every figure: blue if it is marked transferable, orange if it is marked not
transferable. Blue and orange differ in every common form of color blindness.

Letters: N demonstrations, K clusters, E embedding, M points of a curve.
"""

import io
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib.style
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray
from sklearn.decomposition import PCA
from sklearn.manifold import TSNE
from threadpoolctl import threadpool_limits

from oodil.pipeline.report.formats import count
from oodil.pipeline.results import Evaluation, LearningCurve, Transferability

INK, MUTED, GRID = "#1c2430", "#687181", "#e6e9ee"

TRANSFERABLE = ("#1f5fa8", "#45b0d8", "#12837a", "#8aa9e8", "#123a63")
NOT_TRANSFERABLE = ("#c84a17", "#f2a63b", "#8c3310", "#ec8577", "#b58a12")
UNKNOWN = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#c05200", "#4b5563", "#b3a400")
CLUSTERS = (
    "#2f7d4f",
    "#8458b3",
    "#a8b545",
    "#c25a9d",
    "#4b3b73",
    "#7cc79a",
    "#8c929c",
    "#c9a2e0",
    "#20463a",
    "#7a5c3e",
)
POLICIES = (INK, "#687181", TRANSFERABLE[0], "#8458b3", "#a3461c", "#12736b", "#8c6d1f", "#a03a72")
"""Colors of learning curves, ours first. Curves are named in their colors, so each has a contrast of 4.5 to white."""
TRAINING = ("#12736b", "#8458b3")
"""Colors of a discriminator's accuracy on demonstrations and on the policy's transitions."""
DASHES = ("solid", "solid", (0, (5, 3)), (0, (1, 1.5)))
MARKERS = (("o", "●"), ("s", "■"), ("^", "▲"), ("D", "◆"), ("v", "▼"), ("P", "✚"))
"""Markers of Matplotlib and the characters that stand for them in a legend."""

FEWEST_FOR_TSNE, MOST_FOR_TSNE = 30, 2500
PERPLEXITY = 8.0
"""Less than the size of the smallest source: the paper's have ten demonstrations, which a perplexity of 30 draws as
one dot."""
MOST_AS_VECTORS = 3000
"""With more demonstrations, dots become a bitmap inside the SVG; as vectors they would take megabytes."""

STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "text.color": INK,
    "text.parse_math": False,
    "axes.edgecolor": "#b9c0ca",
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
    "xtick.color": "#b9c0ca",
    "ytick.color": "#b9c0ca",
    "xtick.labelcolor": MUTED,
    "ytick.labelcolor": MUTED,
    "xtick.major.size": 3,
    "ytick.major.size": 0,
    "lines.solid_capstyle": "round",
    "figure.facecolor": "none",
    "svg.fonttype": "none",
}


@dataclass(frozen=True)
class Look:
    """How a source is drawn in every figure and legend."""

    color: str
    marker: str
    glyph: str

    @property
    def text(self) -> str:
        """The color of text on this color: white or ink, whichever has the higher contrast."""
        return max(("#ffffff", INK), key=lambda text: contrast(text, self.color))


@dataclass(frozen=True)
class PolicyResult:
    """What is drawn of a policy."""

    title: str
    curve: LearningCurve | None
    final: Evaluation | None


@dataclass(frozen=True)
class Training:
    """Metrics of one adversarial training, each (M,) and NaN where it was not measured."""

    title: str
    env_steps: NDArray[np.float64]
    demonstration_accuracy: NDArray[np.float64]
    """Share of demonstrated transitions that the discriminator takes for demonstrated."""
    policy_accuracy: NDArray[np.float64]
    """Share of the policy's transitions that the discriminator takes for the policy's."""
    env_return: NDArray[np.float64]
    """Mean true return of the episodes of training, with sampled actions."""


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colors by WCAG 2, from 1 to 21; small text needs 4.5."""
    low, high = sorted((_luminance(one), _luminance(other)))
    return (high + 0.05) / (low + 0.05)


def _luminance(color: str) -> float:
    channels = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def source_looks(transferable: Iterable[bool | None]) -> list[Look]:
    """Return one look per source; the next marker is used when all colors of a family are taken."""
    transferable = list(transferable)
    families = {True: TRANSFERABLE, False: NOT_TRANSFERABLE, None: UNKNOWN}
    if set(transferable) != {None}:
        families[None] = ("#7c5fa8", "#6b7280", "#b49bd4", "#3f3a5c")
    used = {True: 0, False: 0, None: 0}
    looks = []
    for known in transferable:
        family = families[known]
        marker, glyph = MARKERS[used[known] // len(family) % len(MARKERS)]
        looks.append(Look(family[used[known] % len(family)], marker, glyph))
        used[known] += 1
    return looks


def project(features: NDArray[np.float32]) -> tuple[NDArray[np.float64], str] | None:
    """Return (N, 2) points for (N, E) features and the name of the projection; None for features that are all equal."""
    if (
        len(features) < 3
        or features.size == 0
        or not np.isfinite(features).all()
        or np.ptp(features, axis=0).max() == 0
    ):
        return None
    features = features.astype(np.float64)
    # One thread: the order of sums over several threads changes their last bits, which t-SNE amplifies.
    with threadpool_limits(1):
        if FEWEST_FOR_TSNE <= len(features) <= MOST_FOR_TSNE:
            tsne = TSNE(perplexity=PERPLEXITY, init="pca", learning_rate="auto", random_state=0)
            return tsne.fit_transform(features).astype(np.float64), "t-SNE"
        components = PCA(min(2, features.shape[1]), svd_solver="full").fit_transform(features)
    return np.pad(components, ((0, 0), (0, 2 - components.shape[1]))), "PCA"


def embedding(
    points: NDArray[np.float64], clusters: NDArray[np.int32], sources: NDArray[np.int32], looks: list[Look]
) -> Markup:
    """Draw (N, 2) points twice: in the colors of their clusters (N,), which are numbered, and of their sources (N,)."""
    size = float(np.clip(6000 / len(points), 7, 60))
    with _drawing("embedding", 11, 5.0) as (figure, svg):
        left, right = figure.subplots(1, 2, gridspec_kw={"wspace": 0.03})
        for axes, title in ((left, "by cluster"), (right, "by source")):
            axes.set_title(title)
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
            axes.set_facecolor("#f7f8fa")
            axes.margins(0.06, 0.1)
        for k in np.unique(clusters):
            member = points[clusters == k]
            _dots(left, member, CLUSTERS[k % len(CLUSTERS)], "o", size, len(points))
        for k in np.unique(clusters):
            member = points[clusters == k]
            x, y = np.median(member[:, 0]), np.quantile(member[:, 1], 0.9)
            box = {"boxstyle": "round,pad=0.3", "facecolor": "white", "edgecolor": CLUSTERS[k % len(CLUSTERS)]}
            left.annotate(
                str(k), (x, y), xytext=(0, 13), textcoords="offset points", ha="center", va="center",
                fontsize=8, fontweight="bold", bbox=box, zorder=5,
            )  # fmt: skip
        for i in _largest_first(sources):
            _dots(right, points[sources == i], looks[i].color, looks[i].marker, size, len(points))
    return Markup(svg.getvalue())


def transferability(scores: NDArray[np.float64], sources: NDArray[np.int32], looks: list[Look]) -> Markup:
    """Draw the scores (N,) from the highest to the lowest, colored by source (N,), and a column for each source."""
    order = np.argsort(-scores, kind="stable")
    rank = np.empty(len(scores))
    rank[order] = np.arange(1, len(scores) + 1)
    with _drawing("transferability", 11, 3.3) as (figure, svg):
        several = len(looks) > 1
        panels = figure.subplots(1, 1 + several, sharey=True, squeeze=False, width_ratios=(3, 1)[: 1 + several])[0]
        axes = panels[0]
        width = min(0.6 * 11 * 72 * 0.8 / len(scores), 9.0)
        size = float(np.clip(5000 / len(scores), 9, 48))
        for i in _largest_first(sources):
            mine = sources == i
            stems = axes.vlines(rank[mine], 0, scores[mine], color=looks[i].color, linewidth=width, alpha=0.30)
            stems.set_capstyle("butt")
            stems.set_rasterized(len(scores) > MOST_AS_VECTORS)
            points = np.stack([rank[mine], scores[mine]], axis=1)
            _dots(axes, points, looks[i].color, looks[i].marker, size, len(scores))
        axes.set_xlim(0.5 - 0.008 * len(scores), len(scores) * 1.008 + 0.5)
        _score_axis(axes, float(scores.max()))
        ticks = [tick for tick in MaxNLocator(8, integer=True).tick_values(1, len(scores)) if 1 < tick <= len(scores)]
        axes.set_xticks([1, *ticks])
        axes.set_xlabel("demonstrations, from the most to the least transferable")
        axes.set_ylabel("transferability")
        if several:
            _columns(panels[1], scores, sources, looks, size)
    return Markup(svg.getvalue())


def _columns(
    axes: Axes, scores: NDArray[np.float64], sources: NDArray[np.int32], looks: list[Look], size: float
) -> None:
    """Draw one column of dots per source, in the order of the legend, with a line at the mean."""
    axes.set(xticks=[], xlim=(-0.6, len(looks) - 0.4))
    axes.set_xlabel("by source, line at the mean")
    for i, look in enumerate(looks):
        mine = scores[sources == i]
        if not len(mine):
            continue
        spread = (np.arange(len(mine)) * 0.618034) % 1.0 - 0.5  # golden ratio: even for any count
        x = i + 0.6 * spread * min(1.0, len(mine) / 30)
        _dots(axes, np.stack([x, mine], axis=1), look.color, look.marker, 0.7 * size, len(scores))
        axes.hlines(mine.mean(), i - 0.42, i + 0.42, color=INK, linewidth=1.6, zorder=4)


def convergence(found: Transferability, colors: dict[int, str]) -> Markup:
    """Draw each cluster in a panel: 2 (1 - D) of its training's discriminator, and as a mark what was read at the end.

    The line is the mean over the cluster's demonstrations, the band and the bar are from the 10 to the 90 % quantile.
    """
    histories = found.history
    curves = {k: np.minimum(1, 2 * np.exp(-np.logaddexp(0, seen.logits))) for k, seen in histories.items()}
    columns = min(len(histories), 5)
    rows = -(-len(histories) // columns)
    highest = max(float(found.scores.max()), *(float(scores.max()) for scores in curves.values()))
    with _drawing("convergence", 11, 0.75 + 1.75 * rows) as (figure, svg):
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
            _score_axis(axes, highest, note=False)
            _steps_axis(axes, 4)
        figure.supxlabel("environment steps of the cluster's imitator", fontsize=8.5, color=MUTED)
        panels[0, 0].set_ylabel("transferability")
    return Markup(svg.getvalue())


def learning(policies: list[PolicyResult]) -> Markup:
    """Draw true returns over environment steps, with a band of one standard deviation over episodes.

    A policy without a curve is a line at its final return. Policies without finite returns are left out.
    """
    with _drawing("learning", 11, 3.7) as (figure, svg):
        axes = figure.subplots()
        ends: list[tuple[float, str, str]] = []
        last_step = 0
        # Ours is drawn last, on top.
        for i, policy in reversed(list(enumerate(policies))):
            color, dashes = POLICIES[i % len(POLICIES)], DASHES[min(i, len(DASHES) - 1)]
            curve, width = policy.curve, 1.8 if i else 2.4
            if curve is not None and np.isfinite(curve.mean_return).any():
                low, high = curve.mean_return - curve.std_return, curve.mean_return + curve.std_return
                axes.fill_between(curve.env_steps, low, high, color=color, alpha=0.13, linewidth=0)
                axes.plot(
                    curve.env_steps, curve.mean_return, color=color, linewidth=width, linestyle=dashes,
                    marker="o", markersize=3.2,
                )  # fmt: skip
                ends.append((float(curve.mean_return[np.isfinite(curve.mean_return)][-1]), policy.title, color))
                last_step = max(last_step, int(curve.env_steps[-1]))
            elif policy.final is not None and np.isfinite(policy.final.mean_return):
                axes.axhline(policy.final.mean_return, color=color, linewidth=width, linestyle=dashes)
                ends.append((policy.final.mean_return, policy.title, color))
        axes.set_xlim(0, (last_step or 1) * 1.01)
        axes.set_ylim(bottom=min(0, axes.get_ylim()[0]))
        _name_lines(axes, ends)
        _steps_axis(axes, 8)
        axes.yaxis.set_major_formatter(FuncFormatter(_tick))
        axes.set_xlabel("environment steps")
        axes.set_ylabel("return")
    return Markup(svg.getvalue())


def trainings(panels: list[Training]) -> Markup:
    """Draw each training in a column: the accuracy of its discriminator on either side, and below it the return."""
    columns = min(len(panels), 5)
    rows = -(-len(panels) // columns)
    with _drawing("trainings", 11, 0.5 + 2.9 * rows) as (figure, svg):
        grid = figure.subplots(2 * rows, columns, squeeze=False, sharex=True, gridspec_kw={"wspace": 0.07})
        finite = [each.env_return[np.isfinite(each.env_return)] for each in panels]
        low, high = (reach(np.concatenate([[0.0], *finite])) for reach in (np.min, np.max))
        for i in range(rows * columns):
            accuracy, returns = (grid[2 * (i // columns) + below, i % columns] for below in (0, 1))
            if i >= len(panels):
                accuracy.set_visible(False)
                returns.set_visible(False)
                continue
            panel = panels[i]
            sides = ((panel.demonstration_accuracy, TRAINING[0], "-"), (panel.policy_accuracy, TRAINING[1], "--"))
            for values, color, dashes in sides:
                known = np.isfinite(values)
                accuracy.plot(panel.env_steps[known], values[known], color=color, linewidth=1.3, linestyle=dashes)
            accuracy.set_title(panel.title, fontweight="bold")
            accuracy.set(ylim=(-0.03, 1.03), yticks=(0, 0.5, 1))
            known = np.isfinite(panel.env_return)
            returns.plot(panel.env_steps[known], panel.env_return[known], color=INK, linewidth=1.3)
            returns.set_ylim(low, high * 1.05 or 1)
            returns.yaxis.set_major_locator(MaxNLocator(4))
            returns.yaxis.set_major_formatter(FuncFormatter(_tick))
            returns.tick_params(labelbottom=True)
            _steps_axis(returns, 4)
            if i % columns:
                accuracy.tick_params(labelleft=False)
                returns.tick_params(labelleft=False)
            else:
                accuracy.set_ylabel("accuracy")
                returns.set_ylabel("return")
        figure.supxlabel("environment steps of the training", fontsize=8.5, color=MUTED)
    return Markup(svg.getvalue())


def _name_lines(axes: Axes, ends: list[tuple[float, str, str]]) -> None:
    """Write the names of lines beside their last values, moved up where they would overlap."""
    low, high = axes.get_ylim()
    apart = 0.065 * (high - low)
    placed = -np.inf
    for value, name, color in sorted(ends):
        placed = max(value, placed + apart)
        axes.annotate(
            name, (1.0, placed), xytext=(8, 0), xycoords=("axes fraction", "data"), textcoords="offset points",
            color=color, va="center", fontweight="bold", annotation_clip=False,
        )  # fmt: skip


def _largest_first(sources: NDArray[np.int32]) -> list[int]:
    """Return the sources in the order of drawing: rare ones last, on top."""
    present, counts = np.unique(sources, return_counts=True)
    return [int(i) for i in present[np.argsort(-counts, kind="stable")]]


def _dots(axes: Axes, points: NDArray[np.float64], color: str, marker: str, size: float, total: int) -> None:
    axes.scatter(
        points[:, 0], points[:, 1], s=size, c=color, marker=marker, linewidths=0.35, edgecolors="white", zorder=3,
        rasterized=total > MOST_AS_VECTORS,
    )  # fmt: skip


def _score_axis(axes: Axes, highest: float, note: bool = True) -> None:
    axes.set_ylim(0, max(0.56, min(1.0, highest * 1.06)))
    axes.axhline(0.5, color=MUTED, linewidth=0.8, linestyle=(0, (2, 3)), zorder=1)
    if note:
        axes.annotate(
            "0.5: indistinguishable from the imitator", (1.0, 0.5), xytext=(0, 2), textcoords="offset points",
            xycoords=axes.get_yaxis_transform(), ha="right", va="bottom", fontsize=7.5, color=MUTED,
        )  # fmt: skip


def _steps_axis(axes: Axes, bins: int) -> None:
    axes.xaxis.set_major_locator(MaxNLocator(bins, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: count(value)))


def _tick(value: float, _: int) -> str:
    return f"{value:,.0f}" if abs(value) >= 10 else f"{value:g}"


@contextmanager
def _drawing(name: str, width: float, height: float) -> Iterator[tuple[Figure, io.StringIO]]:
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
