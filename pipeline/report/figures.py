"""Figures of the embedding, of the policies and of the trainings, each one SVG element.

Labels of sources stand in legends on the page, not in figures.

Letters: N demonstrations, K clusters, E embedding, M points of a curve.
"""

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray
from sklearn.decomposition import PCA
from sklearn.manifold import TSNE
from threadpoolctl import threadpool_limits

from oodil.pipeline.report.canvas import dots, drawing, largest_first, steps_axis, tick
from oodil.pipeline.report.looks import CLUSTERS, INK, MUTED, POLICIES, SOFT, TRAINING, Look
from oodil.pipeline.results import Evaluation, LearningCurve

DASHES = ("solid", "solid", (0, (5, 3)), (0, (1, 1.5)))
FEWEST_FOR_TSNE, MOST_FOR_TSNE = 30, 2500
PERPLEXITY = 8.0
"""Less than the size of the smallest source: the paper's have ten demonstrations, which a perplexity of 30 draws as
one dot."""


@dataclass(frozen=True)
class PolicyResult:
    """What is drawn of a policy."""

    title: str
    curve: LearningCurve | None
    final: Evaluation | None
    kept_after: int | None
    """Environment steps after which it was what is kept of its training."""


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
    with drawing("embedding", 11, 5.0) as (figure, svg):
        left, right = figure.subplots(1, 2, gridspec_kw={"wspace": 0.03})
        for axes, title in ((left, "by cluster"), (right, "by source")):
            axes.set_title(title)
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
            axes.set_facecolor(SOFT)
            axes.margins(0.06, 0.1)
        for k in np.unique(clusters):
            member = points[clusters == k]
            dots(left, member, CLUSTERS[k % len(CLUSTERS)], "o", size, len(points))
        for k in np.unique(clusters):
            member = points[clusters == k]
            x, y = np.median(member[:, 0]), np.quantile(member[:, 1], 0.9)
            box = {"boxstyle": "round,pad=0.3", "facecolor": "white", "edgecolor": CLUSTERS[k % len(CLUSTERS)]}
            left.annotate(
                str(k), (x, y), xytext=(0, 13), textcoords="offset points", ha="center", va="center",
                fontsize=8, fontweight="bold", bbox=box, zorder=5,
            )  # fmt: skip
        for i in largest_first(sources):
            dots(right, points[sources == i], looks[i].color, looks[i].marker, size, len(points))
    return Markup(svg.getvalue())


def learning(policies: list[PolicyResult]) -> Markup:
    """Draw true returns over environment steps, with a band of one standard deviation over episodes.

    A star marks what is kept of a training, at its final return. A policy without a curve is a line there. Policies
    without finite returns are left out.
    """
    with drawing("learning", 11, 3.7) as (figure, svg):
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
                if policy.final is not None and policy.kept_after is not None:
                    axes.plot(policy.kept_after, policy.final.mean_return, "*", color=color, markersize=13)
            elif policy.final is not None and np.isfinite(policy.final.mean_return):
                axes.axhline(policy.final.mean_return, color=color, linewidth=width, linestyle=dashes)
                ends.append((policy.final.mean_return, policy.title, color))
        axes.set_xlim(0, (last_step or 1) * 1.01)
        axes.set_ylim(bottom=min(0, axes.get_ylim()[0]))
        _name_lines(axes, ends)
        steps_axis(axes, 8)
        axes.yaxis.set_major_formatter(FuncFormatter(tick))
        axes.set_xlabel("environment steps")
        axes.set_ylabel("return")
    return Markup(svg.getvalue())


def trainings(panels: list[Training]) -> Markup:
    """Draw each training in a column: the accuracy of its discriminator on either side, and below it the return."""
    columns = min(len(panels), 5)
    rows = -(-len(panels) // columns)
    with drawing("trainings", 11, 0.5 + 2.9 * rows) as (figure, svg):
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
            returns.yaxis.set_major_formatter(FuncFormatter(tick))
            returns.tick_params(labelbottom=True)
            steps_axis(returns, 4)
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
