"""A method of your own in one file: a weighting, and a policy that learns from what it weighs; run beside ours.

python examples/own_weighting.py [CONFIG [RUN_DIR]]     # default: smoke, which learns nothing
"""

import sys
from typing import Any

import numpy as np

import oodil
from oodil.pipeline.artifacts import Files
from oodil.pipeline.stage import JobContext, Run
from oodil.pipeline.stages.demonstrations import load_demonstrations


class Pace(oodil.Weighting):
    """Scores a demonstration by how fast its root moves forward: a baseline that knows nothing of the imitator."""

    name = "pace"
    title = "pace"
    version = 1  # raise it when the meaning of the code changes
    inputs = ("demonstrations",)

    def settings(self, config: oodil.RunConfig) -> dict[str, Any]:
        """Return what of the configuration changes the result: nothing."""
        return {}

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Score the run's demonstrations."""
        return self.score(run, load_demonstrations(run)).files()

    def score(self, run: Run, demonstrations: oodil.Demonstrations) -> oodil.Transferability:
        """Score any demonstrations, in [0, 1]; weights sum to one."""
        states = (demonstrations[n] for n in range(len(demonstrations)))
        pace = np.array([max(0.0, float(each[-1, 0] - each[0, 0])) / (len(each) - 1) for each in states])
        scores = pace / pace.max()
        no_clusters, exact = np.full(len(scores), -1, np.int32), np.stack((scores, scores), axis=1)
        return oodil.Transferability(scores, scores / scores.sum(), no_clusters, intervals=exact, threshold=0.5)


oodil.register(Pace())
oodil.register(oodil.PolicyStage("fast_ones", title="fast ones", weighting="pace"))

if __name__ == "__main__":
    config = sys.argv[1] if len(sys.argv) > 1 else "smoke"
    run_dir = sys.argv[2] if len(sys.argv) > 2 else f"runs/{config.replace('/', '-')}-own-weighting"
    # Worker processes import a method by the name of its module, which a script does not have: so none here.
    run = oodil.run(config, ["baselines=[naive_gail, fast_ones]"], workers=0, run_dir=run_dir)
    for policy in run.policies:
        print(f"{policy.title}: final return {run.evaluation(policy.name).mean_return:.0f}")
