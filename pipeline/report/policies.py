"""The policies on the page: what they reach, and which of their trainings was kept."""

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from oodil.pipeline.report import figures, formats
from oodil.pipeline.report.figures import PolicyResult
from oodil.pipeline.report.summary import Findings


@dataclass(frozen=True)
class PolicyRow:
    """A policy in the table of policies."""

    title: str
    weighting: str
    """Title of the weighting it learns with; empty for none."""
    mean_return: float | None
    spread: str
    episodes: int | None
    env_steps: int | None


@dataclass(frozen=True)
class TrainingRow:
    """One of several trainings of a policy."""

    policy: str
    """Its title."""
    name: str
    kept: bool
    kept_after: int
    distance: str
    mean_return: float


@dataclass(frozen=True)
class PolicySection:
    """What the policies reach."""

    figure: Markup | None
    curve_episodes: tuple[int, ...]
    """Different numbers of episodes per point of the curves."""
    rows: tuple[PolicyRow, ...]
    trainings: tuple[TrainingRow, ...]
    """Of policies with several; the one that was kept is the first of each."""


def read_policies(found: Findings) -> PolicySection | None:
    """Return what the finished policies reach; None while there is none."""
    results = found.results
    if not found.finals:
        return None
    drawn, rows = [], []
    for policy in results.policies:
        final = found.finals.get(policy.name)
        curve = results.curve(policy.name) if final else None
        kept_after = results.trainings(policy.name).trainings[0].kept_after if final else None
        drawn.append(PolicyResult(policy.title, curve if curve and len(curve.env_steps) else None, final, kept_after))
        row = PolicyRow(
            title=policy.title,
            weighting=found.title(policy.weighting) if policy.weighting else "",
            mean_return=final.mean_return if final else None,
            spread=formats.spread(final.std_return, final.mean_return) if final else "",
            episodes=len(final) if final else None,
            env_steps=results.policy(policy.name).env_steps if final else None,
        )
        rows.append(row)
    finite = any(each.final and np.isfinite(each.final.mean_return) for each in drawn)
    episodes = sorted({each.curve.episodes for each in drawn if each.curve})
    trainings = tuple(row for policy in results.policies for row in _trainings(found, policy.name))
    return PolicySection(figures.learning(drawn) if finite else None, tuple(episodes), tuple(rows), trainings)


def _trainings(found: Findings, policy: str) -> list[TrainingRow]:
    if policy not in found.finals:
        return []
    held = found.results.trainings(policy).trainings
    rows = [
        TrainingRow(
            policy=found.title(policy),
            name=training.job.replace("-", " "),
            kept=training is held[0],
            kept_after=training.kept_after,
            distance=formats.decimal(training.distance),
            mean_return=training.mean_return,
        )
        for training in held
    ]
    return rows if len(rows) > 1 else []
