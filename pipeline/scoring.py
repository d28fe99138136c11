"""What a finished run says of demonstrations that come later: one inference by frozen models, nothing is trained.

Letters: N demonstrations.
"""

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from oodil.pipeline.data import Demonstrations
from oodil.pipeline.errors import NotFinishedError
from oodil.pipeline.results import Transferability
from oodil.pipeline.runs import RunResults
from oodil.pipeline.stages.weighting import CannotScoreError


@dataclass(frozen=True)
class Scored:
    """Demonstrations that came later, and what the weightings of a run say of them."""

    demonstrations: Demonstrations
    found: dict[str, Transferability]
    """By the weighting's name, ours first; weights are among these demonstrations alone."""
    refused: dict[str, str]
    """By the name of a weighting that says nothing of them, why."""

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return (N,) arrays by the names that files use: the first weighting's as in `Transferability.columns`.

        Those of every other one begin with its name, as in ``distance_weight``.
        """
        columns: dict[str, NDArray[Any]] = {}
        for name, found in self.found.items():
            prefix = f"{name}_" if columns else ""
            columns |= {f"{prefix}{column}": values for column, values in found.columns().items()}
        return columns


def score(results: RunResults, demonstrations: Demonstrations, weighting: str | None = None) -> Scored:
    """Return what one weighting of a run, or each that can, says of demonstrations that were not part of it.

    Raises DataError for states of another dimension, and the reason if no weighting can score them: CannotScoreError,
    NotFinishedError, or ConfigError for one that the run does not have.
    """
    if weighting is not None:
        return Scored(demonstrations, {weighting: results.score(demonstrations, weighting)}, {})
    found: dict[str, Transferability] = {}
    refused: dict[str, CannotScoreError | NotFinishedError] = {}
    for each in results.weightings:
        try:
            found[each.name] = results.score(demonstrations, each.name)
        except (CannotScoreError, NotFinishedError) as error:
            refused[each.name] = error
    if not found:
        raise next(iter(refused.values()))
    return Scored(demonstrations, found, {name: str(error) for name, error in refused.items()})
