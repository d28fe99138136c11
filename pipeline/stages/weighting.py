"""The contract of a weighting: a stage that gives every demonstration a score and a weight."""

from abc import abstractmethod

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.algorithms.weights import kept_weights
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.errors import OodilError
from oodil.pipeline.results import Transferability
from oodil.pipeline.stage import Run, Stage


class Weighting(Stage):
    """A stage whose artifact is a `Transferability`; a policy learns from demonstrations as it weighs them."""

    title: str
    """What it is called in tables and figures."""

    def load(self, run: Run) -> Transferability:
        """Return what it says of the run's demonstrations. Raises NotFinishedError."""
        return Transferability.load(run.artifact(self.name))

    def env_steps(self, run: Run) -> int:
        """Return the environment steps that the scores took."""
        return self.load(run).env_steps

    def rule(self, config: RunConfig) -> str:
        """Say, for the report, how a demonstration's weight follows from its score."""
        return "a demonstration is drawn for imitation in proportion to its score"

    def weights(self, found: Transferability) -> NDArray[np.float64]:
        """Return (N,) weights by `rule`, of scores and intervals that were found of demonstrations in several parts."""
        everything = np.zeros((len(found.scores), 2))
        return kept_weights(found.scores, everything, threshold=0.0)

    @abstractmethod
    def score(self, run: Run, demonstrations: Demonstrations) -> Transferability:
        """Return what it says of other demonstrations, from its finished artifact alone: nothing is trained.

        Their states have as many dimensions as those of the run (`RunResults.score` refuses others).
        Raises `CannotScoreError` for a weighting that knows nothing of demonstrations it was not made with.
        """


class CannotScoreError(OodilError):
    """A weighting that cannot score demonstrations which were not part of its run."""
