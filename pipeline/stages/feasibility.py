"""The competing method f-MDP: a demonstration weighs as much as a policy that tracks it can stay close to it.

One policy for all demonstrations, which can score others, or one for each source, as in the released code: that uses
what our method does not know, and says nothing of new sources.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.algorithms.feasibility import adaptive_alpha, feasibility
from oodil.pipeline.algorithms.standardization import standardization
from oodil.pipeline.artifacts import Files
from oodil.pipeline.collecting import InlineRollouts, collect_in
from oodil.pipeline.config import RunConfig, TrainingConfig
from oodil.pipeline.data import Demonstrations, Unit, UnitResult
from oodil.pipeline.environments import environment_spec, make_batch, why_unplaceable
from oodil.pipeline.environments.tracking import TrackingSimulators, distances
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.results import FeasibilityScale, Tracker, Transferability
from oodil.pipeline.seeding import derive_key, torch_seed
from oodil.pipeline.stage import Cost, JobContext, Run, register
from oodil.pipeline.stages.demonstrations import load_demonstrations
from oodil.pipeline.stages.policies import PolicyStage
from oodil.pipeline.stages.weighting import CannotScoreError, Weighting

SIMULATORS = 32
"""Demonstrations that a trained policy tracks side by side."""


class FeasibilityWeighting(Weighting):
    """Feasibility by one policy that tracks all demonstrations."""

    name = "feasibility"
    title = "f-MDP"
    version = 1
    jobs_are_read = True
    inputs = ("demonstrations",)

    def check(self, config: RunConfig) -> None:
        """Raise ConfigError for an environment that cannot be put where a demonstration begins."""
        if reason := why_unplaceable(config.environment.id, config.environment.dynamics):
            raise ConfigError(f"baselines: f-MDP: {reason}")

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the section, how policies learn, the steps of all together, and the environment."""
        section, environment = config.f_mdp.model_dump(), config.environment.settings()
        return {
            "f_mdp": section,
            "learning": _learning(config),
            "steps": config.cluster_steps,
            "environment": environment,
        }

    def cost(self, config: RunConfig) -> Cost:
        """Return the cost of the one policy."""
        return Cost.of_training(config.cluster_steps)

    def jobs(self, run: Run) -> list[str]:
        """Return the one policy."""
        return ["shared"]

    def members(self, demonstrations: Demonstrations, job: str) -> NDArray[np.intp]:
        """Return the demonstrations that a job's policy tracks."""
        return np.arange(len(demonstrations))

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Train a policy to track demonstrations, and see how far its mean actions stay from each."""
        from oodil.pipeline.algorithms.learner import EnvReward, Learner
        from oodil.pipeline.training import train

        config, demonstrations = run.config, load_demonstrations(run)
        members = self.members(demonstrations, job)
        tracked, scale = demonstrations.select(members), _scale(config, demonstrations)
        training = training_config(config, tracked, len(self.jobs(run)))
        simulators = _tracking(config, training.simulators_per_group, tracked, scale)

        def collect(unit: Unit) -> UnitResult:
            return collect_in(simulators, unit)

        spec = environment_spec(config.environment.id, config.environment.dynamics)
        seed = torch_seed(derive_key(config.seed, "feasibility", job))
        learner = Learner(2 * spec.observation_dim, spec.action_dim, training, EnvReward(), seed)
        checkpoints, rollouts = self.checkpoints(run, job), InlineRollouts(collect)
        train(learner, config.environment, training, [], context, checkpoints, rollouts=rollouts)
        policy = learner.behavior_policy()
        return Tracker(policy, members, _distances(config, policy, tracked, scale)).files()

    def combine(self, run: Run) -> Files:
        """Turn the distances of all policies into feasibility and weights."""
        demonstrations, jobs = load_demonstrations(run), self.jobs(run)
        found, env_steps = np.empty(len(demonstrations)), int((demonstrations.lengths - 1).sum())
        for job in jobs:
            tracker = Tracker.load(run.job_artifact(self.name, job))
            found[tracker.demonstrations] = tracker.distances
            training = training_config(run.config, demonstrations.select(tracker.demonstrations), len(jobs))
            env_steps += training.env_steps
        alpha = run.config.f_mdp.alpha
        scale = FeasibilityScale(float(found.min()), adaptive_alpha(found) if alpha is None else alpha)
        return _weighted(found, scale, env_steps).files() | scale.files()

    def score(self, run: Run, demonstrations: Demonstrations) -> Transferability:
        """Return the feasibility of other demonstrations by the run's policy, nearest distance and alpha."""
        known = load_demonstrations(run)
        policy = Tracker.load(run.job_artifact(self.name, "shared")).policy
        found = _distances(run.config, policy, demonstrations, _scale(run.config, known))
        return _weighted(found, FeasibilityScale.load(run.artifact(self.name)), env_steps=0)


class PerSourceFeasibility(FeasibilityWeighting):
    """Feasibility by a policy for each source, as in the released code."""

    name = "feasibility_per_source"
    title = "f-MDP, one policy per source"

    def cost(self, config: RunConfig) -> Cost:
        """Return the cost of all policies; how many sources a file has is not known before it is read."""
        return Cost.of_training(config.cluster_steps, len(config.demonstrations.sources) or 1)

    def jobs(self, run: Run) -> list[str]:
        """Return one job per source that has demonstrations, named by its number."""
        return [f"source-{source}" for source in np.unique(load_demonstrations(run).sources)]

    def members(self, demonstrations: Demonstrations, job: str) -> NDArray[np.intp]:
        """Return the demonstrations of a source."""
        return np.flatnonzero(demonstrations.sources == int(job.removeprefix("source-")))

    def score(self, run: Run, demonstrations: Demonstrations) -> Transferability:
        """Raise CannotScoreError: there is no policy for another source."""
        raise CannotScoreError(
            f"{self.name} has a policy for each source of its run and none for new ones; f_mdp has one for all"
        )


def training_config(config: RunConfig, tracked: Demonstrations, num_policies: int) -> TrainingConfig:
    """Return the training of one of some policies, which share the steps of our clusters' imitators evenly.

    It learns as those do, but from whole episodes: rewards are next to nothing after a few dozen steps, so a batch
    without beginnings would be noise. There is no lag, since nobody else collects for it.
    """
    longest = int(tracked.lengths.max()) - 1
    return TrainingConfig.model_validate(
        _learning(config)
        | {
            "total_steps": -(-config.cluster_steps // num_policies),
            "num_groups": 1,
            "simulators_per_group": -(-config.f_mdp.steps_per_iteration // longest),
            "steps_per_rollout": longest,
            "lag": 0,
        }
    )


def _learning(config: RunConfig) -> dict[str, Any]:
    """Return how the imitators of clusters learn from what was collected, their discriminators left out."""
    collected = {"total_steps", "num_groups", "simulators_per_group", "steps_per_rollout", "lag"}
    gail = config.transferability.gail
    return gail.model_dump(mode="json", include=set(TrainingConfig.model_fields) - collected)


def _scale(config: RunConfig, demonstrations: Demonstrations) -> NDArray[np.floating]:
    """Return (S,) what differences of states are multiplied by: a given alpha is in units of the observations."""
    if config.f_mdp.alpha is not None:
        return np.ones(demonstrations.observation_dim)
    return standardization(demonstrations.observations)[1]


def _tracking(
    config: RunConfig, count: int, demonstrations: Demonstrations, scale: NDArray[np.floating]
) -> TrackingSimulators:
    simulators = make_batch(config.environment.id, config.environment.dynamics, count)
    return TrackingSimulators(simulators, demonstrations, config.f_mdp.discount, scale)


def _distances(
    config: RunConfig, policy: GaussianPolicy, demonstrations: Demonstrations, scale: NDArray[np.floating]
) -> NDArray[np.float64]:
    return distances(_tracking(config, SIMULATORS, demonstrations, scale), policy)


def _weighted(found: NDArray[np.float64], scale: FeasibilityScale, env_steps: int) -> Transferability:
    """Return the feasibility of (N,) distances, exact as far as the method knows; none is too small to be drawn."""
    scores = feasibility(found, scale.nearest, scale.alpha)
    clusters, exact = np.full(len(scores), -1, np.int32), np.stack((scores, scores), axis=1)
    return Transferability(scores, scores / scores.sum(), clusters, exact, threshold=0.0, env_steps=env_steps)


register(FeasibilityWeighting())
register(PerSourceFeasibility())
register(PolicyStage("f_mdp", title="f-MDP", weighting="feasibility"))
register(PolicyStage("f_mdp_per_source", title="f-MDP, one policy per source", weighting="feasibility_per_source"))
