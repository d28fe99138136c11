"""How closely a simulator can follow demonstrations: by physics alone, without learning and without any return.

A simulator is placed where a demonstration was, and takes at each step the action that brings it closest to the
demonstration's next state. It goes on from where it really got, so several steps are an attempt to follow.

Letters: R trials, H steps, G simulators, L lengths, S observation, A action.
"""

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Demonstrations, Snapshot
from oodil.pipeline.environments import EnvironmentSpec, Simulators

Floats = NDArray[np.float64]

PERTURBATION = 0.1
"""Of an action for its derivatives; actions are in the units of simulators, [-1, 1] between two bounds."""
DAMPING = 1e-3
"""Added to the squared derivatives, deviations per half range, so that actions without effect stay where they are."""
ATTEMPTS, NEAR = 3, 0.01
"""Actions from which a search begins, one after the other, until one of them ends as near as this."""
LENGTHS = np.array([1.0, 0.3])
"""Shares of a Gauss-Newton step that are tried."""
EXACT = 1e-3
"""Distance, in deviations, at which the search ends."""
ROUNDING = 1e-6
"""A dimension that changes by less of its largest value is constant: that is the rounding of 32 bits."""


def deviations(demonstrations: Demonstrations, steps: int) -> Floats:
    """Return (S,) how much states change within some steps, as deviations over all demonstrations.

    It is infinite where nothing changes, so that the dimension counts for nothing.
    """
    seen = demonstrations.observations.astype(np.float64)
    ends = np.repeat(demonstrations.offsets[1:], demonstrations.lengths)
    rows = np.arange(len(seen))
    rows = rows[rows + steps < ends]
    found = (seen[rows + steps] - seen[rows]).std(axis=0)
    return np.where(found > ROUNDING * np.abs(seen).max(axis=0), found, np.inf)


def distances(reached: Floats, wanted: Floats, units: Floats) -> Floats:
    """Return (R,) root mean square differences of (R, S) states, in ``units`` (S,), over the dimensions that change."""
    return np.sqrt(np.square((reached - wanted) / units).sum(axis=-1) / max(1, np.isfinite(units).sum()))


class Follower:
    """Simulators of one environment, in which any number of trials takes turns."""

    def __init__(self, simulators: Simulators, spec: EnvironmentSpec, iterations: int) -> None:
        """Take over simulators; each action is sought in ``iterations`` Gauss-Newton steps."""
        self.env_steps = 0
        """Steps of all simulators so far."""
        self._simulators = simulators
        self._iterations = iterations
        low, high = spec.bounds()
        self._bounds = low.astype(np.float64), high.astype(np.float64)

    def residuals(
        self, states: Floats, num_trials: int, horizon: int, units: Callable[[int], Floats], rng: np.random.Generator
    ) -> Floats:
        """Return (2, R) distances after one step and after ``horizon`` steps of trials within one demonstration (T, S).

        They begin at states drawn evenly from those that tell where the simulator is. ``units(steps)`` (S,) is what a
        distance after so many steps is measured in. A short demonstration is followed to its end, and one without such
        a state has NaN.
        """
        horizon = min(horizon, len(states) - 1)
        begins = np.flatnonzero(self._simulators.tells_state(states[:-horizon]))
        if not begins.size:
            return np.full((2, num_trials), np.nan)
        wanted = states[rng.choice(begins, num_trials)[:, None] + np.arange(horizon + 1)]
        reached = self.follow(wanted, units(1))
        ends = ((0, 1), (-1, horizon))
        return np.stack([distances(reached[:, at], wanted[:, steps], units(steps)) for at, steps in ends])

    def follow(self, states: Floats, units: Floats) -> Floats:
        """Return (R, H, S) where R trials get that begin at ``states`` (R, H + 1, S) [:, 0] and follow them.

        An action is the one after which the next state is closest in ``units`` (S,).
        """
        here = self._placed(states[:, 0])
        actions = np.tile(np.clip(0.0, *self._bounds), (len(states), 1))
        reached = []
        for wanted in states.swapaxes(0, 1)[1:]:
            start = here

            def seen_after(rows: NDArray[np.intp], tried: Floats, start: Snapshot = start) -> Floats:
                return self._stepped(_rows(start, rows), tried)[1]

            actions = closest_actions(seen_after, wanted, units, actions, self._bounds, self._iterations)
            here, seen = self._stepped(start, actions)
            reached.append(seen)
        return np.stack(reached, axis=1)

    def _placed(self, states: Floats) -> Snapshot:
        """Return where simulators stand that were placed at (R, S) states."""
        parts = []
        for rows in self._turns(len(states)):
            for g, row in enumerate(rows):
                self._simulators.place(g, states[row])
            parts.append(self._simulators.snapshot())
        return _rows(_joined(parts), np.arange(len(states)))

    def _stepped(self, here: Snapshot, actions: Floats) -> tuple[Snapshot, Floats]:
        """Return where R simulators stand after (R, A) actions, and what is then observed (R, S)."""
        parts, seen = [], []
        for rows in self._turns(len(actions)):
            self._simulators.restore(_rows(here, rows))
            self._simulators.step(actions[rows])
            self.env_steps += len(rows)
            parts.append(self._simulators.snapshot())
            seen.append(self._simulators.observations())
        everyone = np.arange(len(actions))
        return _rows(_joined(parts), everyone), np.concatenate(seen)[everyone]

    def _turns(self, count: int) -> list[NDArray[np.intp]]:
        """Return rows for all simulators at a time; the last turn repeats the last row to be full."""
        size = self._simulators.num_simulators
        return [np.minimum(np.arange(begin, begin + size), count - 1) for begin in range(0, count, size)]


def closest_actions(
    seen_after: Callable[[NDArray[np.intp], Floats], Floats],
    wanted: Floats,
    units: Floats,
    actions: Floats,
    bounds: tuple[Floats, Floats],
    iterations: int,
) -> Floats:
    """Return (R, A) actions within ``bounds``, (A,) each, after which R trials are closest to ``wanted`` (R, S).

    The search begins at ``actions`` (R, A) and, where that leads nowhere near, elsewhere: contacts make valleys.
    ``seen_after(rows, actions)`` gives what is observed after one step of each of these trials.
    """
    best, least = actions.copy(), np.full(len(actions), np.inf)
    for attempt in range(ATTEMPTS):
        far = np.flatnonzero(least > NEAR)
        if not far.size:
            break
        # The same for every trial, so that a result does not depend on the trials beside it.
        other = np.clip(np.random.default_rng(attempt).uniform(-1, 1, actions.shape[1]), *bounds)
        begin = np.tile(other, (len(far), 1)) if attempt else best
        found, distance = _gauss_newton(seen_after, far, wanted, units, begin, bounds, iterations)
        better = distance < least[far]
        best[far[better]], least[far[better]] = found[better], distance[better]
    return best


def _gauss_newton(
    seen_after: Callable[[NDArray[np.intp], Floats], Floats],
    rows: NDArray[np.intp],
    wanted: Floats,
    units: Floats,
    begin: Floats,
    bounds: tuple[Floats, Floats],
    iterations: int,
) -> tuple[Floats, Floats]:
    """Return actions for some trials, and the distances that they leave.

    Derivatives come from differences. An action at its bound stays there as long as it would leave.
    """
    (low, high), num_actions = bounds, begin.shape[1]
    identity = np.eye(num_actions)
    scale = units * np.sqrt(max(1, np.isfinite(units).sum()))

    def misses(trying: NDArray[np.intp], tried: Floats) -> Floats:
        """Return (R, L, S) differences after (R, L, A) actions; their norm is the distance."""
        each = tried.shape[1]
        seen = seen_after(np.repeat(rows[trying], each), tried.reshape(-1, num_actions))
        return (seen.reshape(len(trying), each, -1) - wanted[rows[trying], None]) / scale

    best, trying = begin.copy(), np.arange(len(rows))
    miss = misses(trying, best[:, None])[:, 0]
    for _ in range(iterations):
        trying = trying[np.linalg.norm(miss[trying], axis=1) > EXACT]
        if not trying.size:
            break
        at, off = best[trying], miss[trying]
        turn = np.where(at > 0, -PERTURBATION, PERTURBATION)
        slopes = (misses(trying, at[:, None] + turn[:, :, None] * identity) - off[:, None]) / turn[:, :, None]
        downhill = -(slopes @ off[:, :, None])[:, :, 0]
        stays = ((at <= low) & (downhill < 0)) | ((at >= high) & (downhill > 0))
        slopes[stays] = downhill[stays] = 0.0
        normal = slopes @ slopes.swapaxes(1, 2) + DAMPING * identity
        step = np.linalg.solve(normal, downhill[:, :, None])[:, :, 0]
        tried = np.clip(at[:, None] + LENGTHS[:, None] * step[:, None], low, high)
        found = misses(trying, tried)
        sizes = np.linalg.norm(found, axis=2)
        chosen = sizes.argmin(axis=1)
        better = sizes.min(axis=1) < np.linalg.norm(off, axis=1)
        trying, chosen, tried, found = trying[better], chosen[better], tried[better], found[better]
        each = np.arange(len(trying))
        best[trying], miss[trying] = tried[each, chosen], found[each, chosen]
    return best, np.linalg.norm(miss, axis=1)


def _rows(snapshot: Snapshot, rows: NDArray[np.intp]) -> Snapshot:
    return Snapshot(*(getattr(snapshot, field.name)[rows] for field in fields(Snapshot)))


def _joined(parts: list[Snapshot]) -> Snapshot:
    # Some states are as long as what was played, and zeros behind that mean nothing.
    width = max(part.states.shape[1] for part in parts)
    wide = [replace(part, states=np.pad(part.states, ((0, 0), (0, width - part.states.shape[1])))) for part in parts]
    return Snapshot(*(np.concatenate([getattr(part, field.name) for part in wide]) for field in fields(Snapshot)))
