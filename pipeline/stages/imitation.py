"""Stage 4: the policy, by GAIL on weighted demonstrations (Eqn 7 and 8); the baselines differ in weights alone."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import Files, encode_arrays, encode_json
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments import make_batch
from oodil.pipeline.evaluation import evaluate
from oodil.pipeline.seeding import derive_key, torch_seed
from oodil.pipeline.stage import JobContext, Run, Stage, register
from oodil.pipeline.stages.demonstrations import load_demonstrations


class ImitationStage(Stage):
    """Weighted GAIL: one learner fed by rollout workers. Subclasses choose the weights."""

    name = "imitation"
    version = 1
    inputs: tuple[str, ...] = ("demonstrations", "transferability")
    distributed = True

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the section and the imitator's environment."""
        return config.imitation.model_dump(mode="json") | {"environment": config.environment.model_dump()}

    def weights(self, run: Run, demonstrations: Demonstrations) -> NDArray[np.float64]:
        """Return (N,) weights from the transferability."""
        return run.artifact("transferability").arrays("transferability.safetensors")["weights"]

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Train the policy and evaluate it with its mean action."""
        from oodil.pipeline.algorithms.gail import AdversarialReward
        from oodil.pipeline.algorithms.learner import Learner
        from oodil.pipeline.training import Probe, train

        config = run.config
        gail = config.imitation.gail
        environment = config.environment
        demonstrations = load_demonstrations(run)
        seed = torch_seed(derive_key(config.seed, "imitation"))
        simulators = make_batch(environment.id, environment.dynamics, 1)
        weights = self.weights(run, demonstrations)
        reward = AdversarialReward(demonstrations, weights, gail.discriminator, seed)
        learner = Learner(simulators.observation_dim, simulators.action_dim, gail, reward, seed)

        def curve_point() -> NDArray[np.float64]:
            key = derive_key(config.seed, "curve")
            seen = evaluate(
                learner.behavior_policy(), environment.id, environment.dynamics, gail.evaluation_episodes, key
            )
            return np.array([seen.returns.mean(), seen.returns.std(), seen.lengths.mean()])

        probe = Probe("curve", gail.num_evaluations, curve_point)
        history = train(learner, environment, gail, [probe], context, self.checkpoints(run, job))
        policy = learner.behavior_policy()
        episodes = config.imitation.final_episodes
        final = evaluate(policy, environment.id, environment.dynamics, episodes, derive_key(config.seed, "final"))
        curve = history.values("curve").reshape(-1, 3)
        discriminator = {name: value.numpy() for name, value in reward.discriminator.state_dict().items()}
        return {
            "policy.safetensors": encode_arrays(policy.arrays()),
            "policy.json": encode_json({"environment": environment.model_dump(), "activation": "tanh"}),
            "discriminator.safetensors": encode_arrays(discriminator),
            "curve.json": encode_json(
                {
                    "env_steps": history.steps("curve").tolist(),
                    "return_mean": curve[:, 0].tolist(),
                    "return_std": curve[:, 1].tolist(),
                    "length_mean": curve[:, 2].tolist(),
                    "episodes": gail.evaluation_episodes,
                }
            ),
            "evaluation.json": encode_json(
                {
                    "final_return": float(final.returns.mean()),
                    "final_return_std": float(final.returns.std()),
                    "final_length": float(final.lengths.mean()),
                    "episodes": episodes,
                    "env_steps": gail.num_iterations * gail.steps_per_iteration,
                }
            ),
        }


class NaiveGailStage(ImitationStage):
    """GAIL on all demonstrations alike."""

    name = "naive_gail"
    inputs = ("demonstrations",)

    def weights(self, run: Run, demonstrations: Demonstrations) -> NDArray[np.float64]:
        """Return equal weights."""
        return np.ones(len(demonstrations))


class OracleStage(ImitationStage):
    """GAIL on the demonstrations whose sources are marked transferable: what perfect scores would give."""

    name = "oracle"
    inputs = ("demonstrations",)

    def weights(self, run: Run, demonstrations: Demonstrations) -> NDArray[np.float64]:
        """Return one for demonstrations of a source that is marked transferable, zero for all others."""
        marks = [float(source.transferable is True) for source in run.config.demonstrations.sources]
        return np.array(marks)[demonstrations.sources]


register(ImitationStage())
register(NaiveGailStage())
register(OracleStage())
