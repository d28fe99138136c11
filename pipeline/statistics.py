"""Statistics of few seeds, as Agarwal et al. 2021 (https://arxiv.org/abs/2108.13264) advise.

Letters: T tasks (rows of a table), N seeds.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

ENOUGH_SEEDS = 5
"""For an interval; of fewer the values themselves say more."""
RESAMPLES = 2000
COVERED = 0.95
"""Probability of an interval."""


@dataclass(frozen=True)
class Statistics:
    """What is said of one figure over seeds."""

    values: tuple[float, ...]
    """Of each seed."""
    mean: float
    deviation: float
    """Of a sample (n - 1); NaN for one seed."""
    interquartile_mean: float
    interval: tuple[float, float] | None
    """Of the interquartile mean; None with fewer than five seeds."""

    @classmethod
    def of(cls, values: Floats) -> "Statistics":
        """Return the statistics of (N,) values."""
        deviation = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
        limits = interval(values[None]) if len(values) >= ENOUGH_SEEDS else None
        return cls(tuple(values.tolist()), float(values.mean()), deviation, interquartile_mean(values), limits)


def interquartile_mean(values: Floats) -> float:
    """Return the mean of (N,) or (T, N) values without the lowest and the highest quarter of all of them."""
    ordered = np.sort(values, axis=None)
    cut = int(0.25 * len(ordered))
    return float(ordered[cut : len(ordered) - cut].mean())


def interval(values: Floats, seed: int = 0) -> tuple[float, float]:
    """Return the limits of the interquartile mean of (T, N) values, by resampling the seeds of each task.

    It is the stratified percentile bootstrap: a task keeps its number of seeds in every resample.
    """
    tasks, seeds = values.shape
    rng = np.random.default_rng(seed)
    drawn = rng.integers(seeds, size=(RESAMPLES, tasks, seeds))
    resampled = values[np.arange(tasks)[:, None], drawn]
    means = [interquartile_mean(each) for each in resampled]
    low, high = np.quantile(means, [(1 - COVERED) / 2, (1 + COVERED) / 2])
    return float(low), float(high)


def probability_of_improvement(ours: Floats, theirs: Floats) -> float:
    """Return how often one of (N,) values of ours is above one of (M,) of theirs; equal ones count half."""
    difference = ours[:, None] - theirs
    return float(np.mean((difference > 0) + 0.5 * (difference == 0)))


def normalized(returns: Floats, random: float, expert: float) -> Floats:
    """Return returns on a scale where a random policy has 0 and the target's own expert 1.

    Raises ValueError unless the expert is better than the random policy.
    """
    if not expert > random:
        raise ValueError(f"the expert's return {expert:g} is not above the random policy's {random:g}")
    return (returns - random) / (expert - random)
