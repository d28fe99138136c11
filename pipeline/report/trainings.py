"""How the adversarial trainings went, from the metrics that their jobs have written.

Letters: M rows of metrics.
"""

from pathlib import Path

import numpy as np

from oodil.pipeline.metrics import read_metrics
from oodil.pipeline.report.figures import Training
from oodil.pipeline.runs import RunResults
from oodil.pipeline.stages import PolicyStage, stages

FEWEST_ROWS = 2
"""A curve needs two points."""


def read_trainings(results: RunResults) -> dict[str, list[Training]]:
    """Return the adversarial trainings of finished stages: those of the policies together, others by stage.

    A job without metrics, or whose metrics hold no accuracy of a discriminator, is left out.
    """
    found: dict[str, list[Training]] = {}
    for stage in stages(results.config):
        if not results.is_done(stage.name):
            continue
        for job in stage.jobs(results.run):
            path = results.run.directory.metrics(stage.name, job)
            group, title = stage.name, job.replace("-", " ")
            if isinstance(stage, PolicyStage):
                group, title = "policies", f"{stage.title}, {title}"
            training = _read(path, title) if path.is_file() else None
            if training is not None:
                found.setdefault(group, []).append(training)
    return found


def _read(path: Path, title: str) -> Training | None:
    metrics = read_metrics(path)
    needed = ("step", "demonstration_accuracy", "policy_accuracy")
    if any(name not in metrics or len(metrics[name]) < FEWEST_ROWS for name in needed):
        return None
    steps, demonstrations, policy = (metrics[name] for name in needed)
    returns = metrics.get("return", np.full(len(steps), np.nan))
    return Training(title, steps, demonstrations, policy, returns)
