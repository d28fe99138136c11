"""What the records say over seeds: every entry of the table, and what is compared.

Letters: T rows, N seeds.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from oodil.pipeline.errors import DataError
from oodil.pipeline.report import formats
from oodil.pipeline.report.table.records import RESULTS, Records
from oodil.pipeline.statistics import (
    ENOUGH_SEEDS,
    Statistics,
    interquartile_mean,
    interval,
    normalized,
    probability_of_improvement,
)

OURS, ORACLE = "imitation", "oracle"
SWEEP = re.compile(r"(?P<key>.+?)\s*=\s*(?P<value>[-+]?\d[\d_]*\.?\d*(?:[eE][-+]?\d+)?)")
"""A row that is one value of a parameter."""


@dataclass(frozen=True)
class Measure:
    """A figure of a cell."""

    title: str
    shown: Callable[[float], str]
    higher_is_better: bool = True

    def deviation(self, value: float, mean: float) -> str:
        """Return a standard deviation in the digits of its mean; a dash where there is none."""
        if not np.isfinite(value):
            return formats.UNKNOWN
        return formats.spread(value, mean) if self.shown is formats.returned else self.shown(value)

    def best(self, *values: float) -> float:
        """Return the best of some values."""
        return (max if self.higher_is_better else min)(values)


def _number(value: float) -> str:
    return formats.decimal(value, 1 if value % 1 else 0)


MEASURES = {
    "mean_return": Measure("mean return", formats.returned),
    "share_reached": Measure("share of episodes that reach the goal", formats.percent),
    "auroc": Measure("AUROC", formats.decimal),
    "share_before": Measure("transferable share before weighting", formats.percent),
    "share_after": Measure("transferable share after weighting", formats.percent),
    "effective_number": Measure("effective number", _number),
    "distance": Measure("distance to the demonstrations", formats.decimal, higher_is_better=False),
    "env_steps": Measure("environment steps", formats.count, higher_is_better=False),
    "clusters_used": Measure("clusters in use", _number),
    "purity": Measure("purity", formats.decimal),
}
"""What a table can show, by the field of a cell."""


@dataclass(frozen=True)
class Entry:
    """One method on one row, over its seeds."""

    row: str
    method: str
    by_seed: dict[int, float]
    published: float | None
    found: Statistics | None
    """None while no seed has a figure."""
    planned: int
    """How many seeds it is to have."""

    @property
    def is_complete(self) -> bool:
        """Whether every seed has a figure, and there are several: what is there first may be what is better."""
        return 1 < len(self.by_seed) == self.planned


@dataclass(frozen=True)
class Sweep:
    """Rows that are values of one parameter."""

    key: str
    values: dict[str, float]
    """By row."""

    @property
    def logarithmic(self) -> bool:
        """Whether the values are drawn on a logarithmic axis: they are positive and span more than a factor of 100."""
        return min(self.values.values()) > 0 and max(self.values.values()) > 100 * min(self.values.values())


@dataclass(frozen=True)
class Table:
    """The records over seeds."""

    records: Records

    @classmethod
    def of(cls, records: Records, origin: object) -> "Table":
        """Return the table of records. Raises DataError, naming their origin, for a figure that no cell has."""
        if records.figure not in MEASURES:
            allowed = ", ".join(MEASURES)
            raise DataError(f"{origin}/{RESULTS}: figure: {records.figure!r} is none of {allowed}")
        return cls(records)

    @property
    def measure(self) -> Measure:
        """What an entry shows."""
        return MEASURES[self.records.figure]

    @property
    def ours(self) -> str:
        """Name of the method that the others are compared with."""
        return OURS if OURS in self.records.methods else next(iter(self.records.methods))

    @cached_property
    def entries(self) -> dict[tuple[str, str], Entry]:
        """All entries by row and method, in the order of the table."""
        found, planned = {}, self._planned()
        for row in self.records.rows:
            for method in self.records.methods:
                by_seed = self.by_seed(row, method, self.records.figure)
                values = np.array(list(by_seed.values()))
                published = self.records.published.get(row, {}).get(method)
                statistics = Statistics.of(values) if by_seed else None
                found[row, method] = Entry(row, method, by_seed, published, statistics, len(planned[row, method]))
        return found

    def _planned(self) -> dict[tuple[str, str], set[int]]:
        """Return the seeds that each row and method has or is to have; rows may differ in them."""
        records = self.records
        seeds: dict[tuple[str, str], set[int]] = {
            (row, name): set() for row in records.rows for name in records.methods
        }
        for cell in records.cells:
            seeds[cell.row, cell.method].add(cell.seed)
        for row, method, seed in records.missing:
            seeds[row, method].add(seed)
        for failure in records.failed:
            for method in [failure.method] if failure.method else records.methods:
                seeds[failure.row, method].add(failure.seed)
        return seeds

    def by_seed(self, row: str, method: str, figure: str) -> dict[int, float]:
        """Return a figure of a row and method by seed, where it is known."""
        mine = (cell for cell in self.records.cells if (cell.row, cell.method) == (row, method))
        values = {cell.seed: getattr(cell, figure) for cell in mine}
        return {seed: float(values[seed]) for seed in sorted(values) if values[seed] is not None}

    @property
    def marks_rows(self) -> bool:
        """Whether it is the best of each row that is marked."""
        return not self.records.published and len(self.records.methods) > 1

    @cached_property
    def marked(self) -> dict[tuple[str, str], str]:
        """Which figure of an entry is marked, by row and method: ours (``found``) or the paper's (``published``).

        It is the better of the two; in a table without published figures, the best entry of each row with several.
        """
        marks = {}
        for row in self.records.rows:
            entries = {method: self.entries[row, method] for method in self.records.methods}
            means = {method: entry.found.mean for method, entry in entries.items() if entry.found}
            for method, mean in means.items():
                published = entries[method].published
                if self.marks_rows and mean == self.measure.best(*means.values()):
                    marks[row, method] = "found"
                elif published is not None:
                    better = self.measure.best(mean, published)
                    marks[row, method] = "found" if mean == better else "published"
        return marks

    @cached_property
    def sweep(self) -> Sweep | None:
        """The parameter whose values the rows are; None for other rows."""
        parts = [SWEEP.fullmatch(row) for row in self.records.rows]
        matches = [each for each in parts if each]
        keys = {each["key"] for each in matches}
        if len(matches) < max(2, len(parts)) or len(keys) > 1:
            return None
        return Sweep(keys.pop(), {each.string: float(each["value"]) for each in matches})

    def improvement(self, row: str, method: str) -> float | None:
        """Return how probably ours is better than a method on a row; None without enough seeds of both."""
        ours, theirs = (np.array(list(self.entries[row, name].by_seed.values())) for name in (self.ours, method))
        if method == self.ours or min(len(ours), len(theirs)) < ENOUGH_SEEDS:
            return None
        probability = probability_of_improvement(ours, theirs)
        return probability if self.measure.higher_is_better else 1 - probability

    def normalized(self, row: str, method: str) -> dict[int, float] | None:
        """Return the returns of a row and method by seed, 0 for a random policy and 100 for the target's own expert.

        None where one of the two is not known, or the expert is no better.
        """
        random, expert = self.records.random_return.get(row), self.records.expert_return.get(row)
        returns = self.by_seed(row, method, "mean_return")
        if random is None or expert is None or not expert > random or not returns:
            return None
        scores = 100 * normalized(np.array(list(returns.values())), random, expert)
        return dict(zip(returns, scores.tolist(), strict=True))

    def overall(self, method: str) -> tuple[float, tuple[float, float] | None] | None:
        """Return the interquartile mean of the normalized returns (T, N) of all rows, and its interval.

        The seeds are those that every row has. There is no interval with fewer than five, and nothing with none.
        """
        each = [self.normalized(row, method) for row in self.records.rows]
        if len(each) < 2 or any(scores is None for scores in each):
            return None
        common = sorted(set.intersection(*(set(scores) for scores in each if scores)))
        if not common:
            return None
        scores = np.array([[known[seed] for seed in common] for known in each if known])
        return interquartile_mean(scores), interval(scores) if scores.shape[1] >= ENOUGH_SEEDS else None

    def sources(self, row: str, method: str) -> Iterator[tuple[str, float | None, float | None]]:
        """Yield each source of a row with the mean over seeds of a method's scores and weights; None if unknown."""
        cells = [cell for cell in self.records.cells if (cell.row, cell.method) == (row, method)]
        for source in dict.fromkeys(label for cell in cells for label in (*cell.scores, *cell.sources)):
            yield (
                source,
                _mean(cell.scores.get(source) for cell in cells),
                _mean(cell.sources.get(source) for cell in cells),
            )


def _mean(values: Iterator[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
