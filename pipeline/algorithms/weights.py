"""From what discriminators say to transferability to weights: the paper's Eqn (6) and (7).

Letters: N demonstrations, R readings.
"""

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Demonstrations

Array = NDArray[np.float64]

LEAST_MODE = 0.01
"""Of all demonstrations: fewer that score alike are no mode by which the others are judged, nor is a single one."""


def transferability_of_divergences(divergences: Array) -> Array:
    """Return 2 (1 - D) in [0, 1], where D tells a demonstration from the imitator's own fresh episodes.

    1: it cannot be told from them; 0: nothing of it is reproduced. D = sigmoid(divergence / 2) is Eqn (6) with a logit
    that is as high over the demonstration as it is low over the episodes, which no discriminator that is biased to
    either side, by their numbers or by settling, can change.
    """
    return np.minimum(1, 2 * np.exp(-np.logaddexp(0, divergences / 2)))


def share_lasted(demonstrations: Demonstrations, horizon: int) -> Array:
    """Return (N,) shares of ``horizon`` steps that the demonstrations lasted; 1 for those that did not fail.

    All demonstrations are scored over the whole horizon, and nothing can be reproduced after a failure: one that fell
    after a tenth of the horizon scores at most a tenth, however well that tenth can be imitated.
    """
    lasted = np.minimum(1.0, (demonstrations.lengths - 1) / horizon)
    return np.where(demonstrations.terminated, lasted, 1.0)


def best_mode(readings: Array, clusters: NDArray[np.int32], share: float) -> float:
    """Return the best score of a mode: of those demonstrations of a cluster that reach ``share`` of its highest score.

    It is the mean of their (R, N) readings. A cluster may hold another mode as well, which its imitator reproduces
    less; the mean of all would say how many of those there are. A group of fewer than `LEAST_MODE`, or of one, counts
    only if there is no other anywhere.
    """
    by_cluster = [readings[:, clusters == k] for k in np.unique(clusters)]
    for least in (max(2.0, LEAST_MODE * len(clusters)), 1.0):
        found = [score for each in by_cluster if (score := _mode(each, share, least)) is not None]
        if found:
            break
    return max(found)


def _mode(readings: Array, share: float, least: float) -> float | None:
    """Return the score of the best mode of a cluster; with fewer than ``least`` alike the next highest score counts."""
    best_first = readings[:, np.argsort(-readings.mean(axis=0), kind="stable")]
    scores = best_first.mean(axis=0)
    for first, highest in enumerate(scores):
        alike = np.flatnonzero(scores[first:] >= share * highest) + first
        if len(alike) >= least:
            return float(best_first[:, alike].mean())
    return None


def kept_weights(scores: Array, intervals: Array, threshold: float) -> Array:
    """Return (N,) weights that sum to one: the scores of those whose whole interval (N, 2) reaches the threshold.

    If there is none, those count whose interval holds it; if there is no such either, all that have a score count the
    same. What has none, NaN, weighs nothing: all weights are 0 where no demonstration has a score.
    """
    for limit in intervals.T:
        weights = np.where(limit >= threshold, np.nan_to_num(scores), 0.0)
        if weights.sum() > 0:
            return np.asarray(weights / weights.sum())
    scored = np.isfinite(scores)
    return np.asarray(scored / max(scored.sum(), 1))


def intervals(readings: Array, seen: NDArray[np.bool_]) -> Array:
    """Return (N, 2) intervals of (R, N) scores: two standard errors around the mean; [0, 1] with one reading.

    So it is as well for those (N,) that were ``seen``: what read them was trained on them.
    """
    spread = (
        2 * readings.std(axis=0, ddof=1) / len(readings) ** 0.5 if len(readings) > 1 else np.ones(readings.shape[1])
    )
    spread[seen] = 1
    middle = readings.mean(axis=0)
    return np.clip(np.stack((middle - spread, middle + spread), axis=1), 0, 1)


def effective_number(weights: Array) -> float:
    """Return how many demonstrations of equal weight would be as even: (sum w)^2 / sum w^2 of (N,) weights."""
    return float(weights.sum() ** 2 / np.square(weights).sum()) if weights.any() else 0.0


def sampling_mass(weights: Array, demonstrations: Demonstrations) -> Array:
    """Return (N,) shares of the sampled transitions, proportional to weight times number of transitions (Eqn 7).

    They sum to one, or are all 0 as the weights are.
    """
    mass = weights * (demonstrations.lengths - 1)
    return np.asarray(mass / mass.sum() if weights.any() else mass)
