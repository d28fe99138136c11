"""Stage 5: a policy, by GAIL on weighted demonstrations (Eqn 7 and 8); policies differ in their weightings."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import Files
from oodil.pipeline.config import GailConfig, RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments import environment_spec
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.evaluation import CANDIDATE_EPISODES, DISTANCE_EPISODES, distance_of, evaluate
from oodil.pipeline.results import LearningCurve, Policy, Training, Trainings, discriminator_file, value_file
from oodil.pipeline.seeding import derive_key, torch_seed
from oodil.pipeline.stage import Cost, JobContext, Run, Stage, register, stage_named
from oodil.pipeline.stages.demonstrations import load_demonstrations
from oodil.pipeline.stages.weighting import Weighting

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.gail import AdversarialReward
    from oodil.pipeline.algorithms.learner import Learner


class PolicyStage(Stage):
    """Weighted GAIL under a name: one learner fed by rollout workers.

    A competing method is an instance with a weighting of its own, registered beside it.
    """

    version = 7
    distributed = True

    def __init__(self, name: str, title: str, weighting: str | None) -> None:
        """Name a policy.

        Args:
            name: of the stage, the policy and its folder.
            title: what it is called in tables and figures.
            weighting: the stage that weighs the demonstrations; without one all weigh the same.
        """
        self.name = name
        self.title = title
        self.weighting = weighting
        self.inputs = ("demonstrations",) if weighting is None else ("demonstrations", weighting)

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the number of trainings and what each depends on."""
        return self.job_settings(config) | {"num_trainings": config.imitation.num_trainings}

    def job_settings(self, config: RunConfig) -> dict[str, Any]:
        """Return what a training depends on."""
        gail = self.gail(config).model_dump(mode="json")
        candidates = config.imitation.num_candidates
        return {"gail": gail, "num_candidates": candidates, "environment": config.environment.settings()}

    def gail(self, config: RunConfig) -> GailConfig:
        """Return how each training is done."""
        return config.imitation.gail

    def begin(self, run: Run, job: str, learner: "Learner[AdversarialReward]") -> tuple[bool, int]:
        """Bring a new learner to where a training begins.

        Return whether that is something that has been trained before, and the environment steps that it took to decide.
        """
        return False, 0

    def jobs(self, run: Run) -> list[str]:
        """Return the trainings."""
        return [f"training-{n}" for n in range(1, run.config.imitation.num_trainings + 1)]

    def env_steps(self, run: Run) -> int:
        """Return the environment steps of all trainings."""
        return sum(training.env_steps for training in Trainings.load(run.artifact(self.name)).trainings)

    def demonstrations(self, run: Run) -> Demonstrations:
        """Return what it learns from."""
        return load_demonstrations(run)

    def cost(self, config: RunConfig) -> Cost:
        """Return the cost of all trainings, and of the episodes by which they are measured."""
        gail, jobs, evaluation = self.gail(config), config.imitation.num_trainings, config.evaluation
        cost = Cost.of_training(jobs * gail.env_steps, jobs)
        return replace(
            cost,
            episodes=jobs * (config.imitation.num_candidates * CANDIDATE_EPISODES + DISTANCE_EPISODES),
            other_episodes=jobs * (evaluation.num_points * evaluation.episodes + evaluation.final_episodes),
        )

    def weights(self, run: Run) -> NDArray[np.float64]:
        """Return (N,) weights of the demonstrations."""
        if self.weighting is None:
            return np.ones(len(self.demonstrations(run)))
        weighting = stage_named(self.weighting)
        assert isinstance(weighting, Weighting)
        return weighting.load(run).weights

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Train the policy, go back to where its mean action came closest, and evaluate it."""
        from oodil.pipeline.algorithms.gail import imitator
        from oodil.pipeline.candidates import Candidates
        from oodil.pipeline.training import Probe, train

        config, evaluation = run.config, run.config.evaluation
        environment, gail = config.environment, self.gail(config)
        spec = environment_spec(environment.id, environment.dynamics)
        # The same seeds for all policies: they differ in their weights, and in where `begin` brings them.
        seed = torch_seed(derive_key(config.seed, "imitation", job))
        demonstrations, weights = self.demonstrations(run), self.weights(run)
        learner = imitator(
            spec.observation_dim, spec.action_dim, spec.max_episode_steps, demonstrations, weights, gail, seed
        )

        def curve_point() -> NDArray[np.float64]:
            policy, key = learner.behavior_policy(), derive_key(config.seed, "curve")
            seen = evaluate(policy, environment.id, environment.dynamics, evaluation.episodes, key)
            return np.array([seen.mean_return, seen.std_return, seen.mean_length])

        goes_on, decided = self.begin(run, job, learner)
        known = [curve_point()] if goes_on and evaluation.num_points else []
        candidates = Candidates(learner, environment, config.imitation.num_candidates)
        probes = [Probe("curve", evaluation.num_points, curve_point), candidates.probe]
        history = train(learner, environment, gail, probes, context, self.checkpoints(run, job))
        kept_after = candidates.keep_closest(history)
        policy = Policy(
            gaussian=learner.behavior_policy(),
            environment_id=environment.id,
            observation_shape=spec.observation_shape,
            action_low=spec.action_low,
            action_high=spec.action_high,
            acts_in_integers=spec.acts_in_integers,
            env_steps=gail.env_steps,
        )
        mean, std, length = np.concatenate([*known, history.values("curve").ravel()]).reshape(-1, 3).T
        steps = np.concatenate([np.zeros(len(known), np.int64), history.steps("curve")])
        curve = LearningCurve(steps, mean, std, length, evaluation.episodes)
        key = derive_key(config.seed, "final")
        final = evaluate(policy.gaussian, environment.id, environment.dynamics, evaluation.final_episodes, key)
        key = derive_key(seed, "distance")
        distance, measured = distance_of(policy.gaussian, learner.reward_model, environment, DISTANCE_EPISODES, key)
        env_steps = policy.env_steps + candidates.env_steps(history) + measured + decided
        training = Training(job, goes_on, env_steps, kept_after, distance, final.mean_return)
        discriminator = discriminator_file(learner.reward_model.discriminator_arrays())
        value = value_file(learner.value_arrays())
        return policy.files() | value | discriminator | curve.files() | final.files() | Trainings((training,)).files()

    def combine(self, run: Run) -> Files:
        """Keep the training whose policy comes closest to the weighted demonstrations; returns play no part."""
        artifacts = {job: run.job_artifact(self.name, job) for job in self.jobs(run)}
        trainings = [Trainings.load(artifact).trainings[0] for artifact in artifacts.values()]
        kept = min(trainings, key=lambda training: training.distance)
        ordered = (kept, *(training for training in trainings if training is not kept))
        return artifacts[kept.job].files() | Trainings(ordered).files()


class AllStepsPolicy(PolicyStage):
    """A policy with as many environment steps as all our trainings take, those of the clusters' imitators included."""

    def gail(self, config: RunConfig) -> GailConfig:
        """Return the training of our policy, with its share of the clusters' steps."""
        gail, share = config.imitation.gail, -(-config.cluster_steps // config.imitation.num_trainings)
        return gail.model_copy(update={"total_steps": gail.total_steps + share})


def refuse_other_widths(name: str, before: GailConfig, gail: GailConfig) -> None:
    """Raise ConfigError unless ``imitation.gail`` has networks as wide as those that it goes on with, of ``name``."""
    for key, old, new in (
        ("policy_hidden", before.policy_hidden, gail.policy_hidden),
        ("value.hidden", before.value.hidden, gail.value.hidden),
    ):
        if old != new:
            raise ConfigError(f"imitation.gail.{key} is {list(new)}; {name} has {list(old)}")


register(PolicyStage("naive_gail", title="naive GAIL", weighting=None))
register(PolicyStage("oracle", title="oracle", weighting="marks"))
register(AllStepsPolicy("naive_gail_all_steps", title="naive GAIL, our steps in all", weighting=None))
register(PolicyStage("id_random", title="ID without GAIL", weighting="inverse_dynamics_random"))
register(PolicyStage("id_gail", title="ID with GAIL", weighting="inverse_dynamics_gail"))
register(PolicyStage("exact_id", title="exact ID", weighting="exact_inverse_dynamics"))
