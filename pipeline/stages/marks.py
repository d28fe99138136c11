"""The weighting that knows what is transferable: one for sources marked so, zero for all others. Behind the oracle."""

from typing import Any

import numpy as np

from oodil.pipeline.artifacts import Files
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.results import Transferability
from oodil.pipeline.stage import JobContext, Run, register
from oodil.pipeline.stages.demonstrations import load_demonstrations, transferable_marks
from oodil.pipeline.stages.weighting import CannotScoreError, Weighting


class MarksWeighting(Weighting):
    """What perfect scores would be: an upper bound for all other weightings, not a method."""

    name = "marks"
    title = "marks"
    version = 2
    inputs = ("demonstrations",)

    def check(self, config: RunConfig) -> None:
        """Raise ConfigError unless some source is marked transferable."""
        section = config.demonstrations
        if not section.transferable and True not in [source.transferable for source in section.sources]:
            raise ConfigError("baselines: the oracle needs sources that are marked transferable: true")

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the marks."""
        section = config.demonstrations
        return {"transferable": list(section.transferable) or [source.transferable for source in section.sources]}

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Look the marks up; what is not marked counts as not transferable."""
        demonstrations = load_demonstrations(run)
        marks = transferable_marks(run.config, demonstrations.source_labels)
        scores = np.array([float(mark is True) for mark in marks])[demonstrations.sources]
        intervals = np.stack((scores, scores), axis=1)
        clusters = np.full(len(scores), -1, np.int32)
        return Transferability(scores, scores / scores.sum(), clusters, intervals, threshold=0.5).files()

    def score(self, run: Run, demonstrations: Demonstrations) -> Transferability:
        """Raise CannotScoreError: the marks are of the run's own sources."""
        raise CannotScoreError("marks say nothing of demonstrations from other sources")


register(MarksWeighting())
