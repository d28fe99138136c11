"""A competing method in one file: demonstrations that cover more ground weigh more. Importing it registers it."""

from typing import Any

import numpy as np

from oodil.pipeline.artifacts import Files
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.results import Transferability
from oodil.pipeline.stage import JobContext, Run, register
from oodil.pipeline.stages import PolicyStage, Weighting
from oodil.pipeline.stages.demonstrations import load_demonstrations


class Distance(Weighting):
    """Scores a demonstration by how far its root gets."""

    name = "distance"
    title = "distance"
    version = 1
    inputs = ("demonstrations",)

    def settings(self, config: RunConfig) -> dict[str, Any]:
        return {}

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        return self.score(run, load_demonstrations(run)).files()

    def score(self, run: Run, demonstrations: Demonstrations) -> Transferability:
        ground = np.array([abs(float(demonstrations[n][-1, 0])) for n in range(len(demonstrations))])
        scores = ground / (1 + ground)
        exact = np.stack((scores, scores), axis=1)
        return Transferability(scores, scores / scores.sum(), np.full(len(scores), -1, np.int32), exact, threshold=0.5)


register(Distance())
register(PolicyStage("far", title="far ones", weighting="distance"))
