"""Beside the method: how closely the imitator's simulator can follow each demonstration, without learning.

Nothing of the method reads it, so a run that has it computes the same as one without. The weighting of a competing
method is made of it: what an inverse model that errs in nothing would say.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from oodil.pipeline.artifacts import Files
from oodil.pipeline.config import EnvironmentConfig, ReproducibilityConfig, RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments import environment_spec, make_batch, why_unplaceable
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.reproducibility import Follower, deviations
from oodil.pipeline.results import Reproducibility
from oodil.pipeline.seeding import derive_key, numpy_rng
from oodil.pipeline.stage import JobContext, JobStoppedError, Run, Stage, register
from oodil.pipeline.stages.demonstrations import load_demonstrations

JOB_SIZE = 50
"""Demonstrations of one job. No result depends on it."""
SIMULATORS = 8
"""Simulators of a job, which the trials share. No result depends on it."""


class ReproducibilityStage(Stage):
    """A job for every few demonstrations; its artifact is `Reproducibility`."""

    name = "reproducibility"
    version = 1
    inputs = ("demonstrations",)

    def check(self, config: RunConfig) -> None:
        """Raise ConfigError for an environment that cannot be put into a state, or shows none to put it into."""
        if reason := why_unplaceable(config.environment.id, config.environment.dynamics):
            raise ConfigError(f"reproducibility: {reason}")

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the imitator's environment and what the trials depend on."""
        return section_of(config).model_dump() | {"environment": config.environment.settings()}

    def jobs(self, run: Run) -> list[str]:
        """Return one job for every few demonstrations, named by the first and the last."""
        count = len(load_demonstrations(run))
        return [f"{first}-to-{min(first + JOB_SIZE, count) - 1}" for first in range(0, count, JOB_SIZE)]

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Follow some of the demonstrations."""
        first, last = map(int, job.split("-to-"))
        config, chosen = run.config, range(first, last + 1)
        demonstrations = load_demonstrations(run)
        return follow(demonstrations, chosen, config.environment, section_of(config), config.seed, context).files()

    def combine(self, run: Run) -> Files:
        """Join the jobs."""
        parts = [Reproducibility.load(run.job_artifact(self.name, job)) for job in self.jobs(run)]
        return Reproducibility.joined(parts).files()

    def env_steps(self, run: Run) -> int:
        """Return the steps of the simulator."""
        return Reproducibility.load(run.artifact(self.name)).env_steps


def follow(
    demonstrations: Demonstrations,
    chosen: Sequence[int],
    environment: EnvironmentConfig,
    section: ReproducibilityConfig,
    seed: int,
    context: JobContext | None = None,
    measure: Demonstrations | None = None,
) -> Reproducibility:
    """Return how closely an environment can follow the chosen demonstrations.

    Distances are in deviations of what all of them change by, or those of ``measure`` instead. The trials of a
    demonstration depend on the ``seed`` and on its number.
    """
    spec = environment_spec(environment.id, environment.dynamics)
    simulators = make_batch(environment.id, environment.dynamics, SIMULATORS)
    follower = Follower(simulators, spec, section.iterations)
    units = lru_cache(lambda steps: deviations(measure or demonstrations, steps))
    found = []
    for done, n in enumerate(chosen):
        if context is not None and context.should_stop():
            raise JobStoppedError(f"stopped after {done} demonstrations")
        rng = numpy_rng(derive_key(seed, "reproducibility", n))
        states = demonstrations[n].astype(np.float64)
        found.append(follower.residuals(states, section.transitions, section.horizon, units, rng))
        if context is not None:
            context.progress(done + 1, len(chosen))
    one_step, horizon = np.stack(found, axis=1)
    return Reproducibility(one_step, horizon, follower.env_steps)


def section_of(config: RunConfig) -> ReproducibilityConfig:
    """Return the section, or its defaults for a run that has the check only because a weighting reads it."""
    return config.reproducibility or ReproducibilityConfig()


register(ReproducibilityStage())
