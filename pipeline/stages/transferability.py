"""Stage 3: one independent GAIL job per cluster; what its discriminators say of every demonstration (Eqn 5 and 6).

The scores are read from each job's discriminator after it has gone on learning for a while against the finished
imitator. The true reward plays no part.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.algorithms.weights import (
    sampling_mass,
    share_lasted,
    sharpened_weights,
    transferability_of_logits,
)
from oodil.pipeline.artifacts import Files, encode_arrays, encode_json
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments import make_batch
from oodil.pipeline.seeding import derive_key, torch_seed
from oodil.pipeline.stage import JobContext, Run, Stage, register
from oodil.pipeline.stages.demonstrations import load_demonstrations, transferable_mask

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.gail import AdversarialReward
    from oodil.pipeline.algorithms.learner import Learner

_JOB_FILE = "scores.safetensors"


@dataclass(frozen=True)
class ClusterJob:
    """The demonstrations of one cluster and an imitator of them in its own environment."""

    config: RunConfig
    members: NDArray[np.intp]
    """Which of all demonstrations they are."""
    demonstrations: Demonstrations
    reward: "AdversarialReward"
    learner: "Learner"
    seed: int

    @classmethod
    def of(cls, run: Run, job: str) -> "ClusterJob":
        """Return the job of that name, untrained."""
        from oodil.pipeline.algorithms.gail import AdversarialReward
        from oodil.pipeline.algorithms.learner import Learner

        environment, gail = run.config.environment, run.config.transferability.gail
        members = np.flatnonzero(_labels(run) == _cluster(job))
        demonstrations = load_demonstrations(run).select(members)
        seed = torch_seed(derive_key(run.config.seed, TransferabilityStage.name, job))
        simulators = make_batch(environment.id, environment.dynamics, 1)
        reward = AdversarialReward(demonstrations, np.ones(len(members)), gail.discriminator, seed)
        learner = Learner(simulators.observation_dim, simulators.action_dim, gail, reward, seed)
        return cls(run.config, members, demonstrations, reward, learner, seed)

    def settle(self, context: JobContext) -> int:
        """Let the discriminator go on against the imitator as it is now; return the environment steps it saw."""
        from oodil.pipeline.training import experience

        environment, section = self.config.environment, self.config.transferability
        horizon = make_batch(environment.id, environment.dynamics, 1).max_episode_steps
        policy = self.learner.behavior_policy()
        batch = experience(policy, environment, section.gail, horizon, self.seed, context)
        self.reward.settle(batch, section.final_steps, section.gail.steps_per_iteration)
        return len(batch)


def told_apart(config: RunConfig, scores: NDArray[np.float64], demonstrations: Demonstrations) -> dict[str, float]:
    """Return how well (N,) scores tell the sources that are marked transferable from those that are marked not to be.

    ``auroc``, and the former's share of the sampling mass: before weighting, by the scores, by their power. Empty
    without marks of both kinds.
    """
    marked = transferable_mask(config, demonstrations)
    if marked is None or not 0 < marked.sum() < len(marked):
        return {}
    from sklearn.metrics import roc_auc_score

    weights = {
        "transferable_share_before": np.ones(len(demonstrations)),
        "transferable_share_unsharpened": scores,
        "transferable_share": sharpened_weights(scores, config.transferability.sharpening),
    }
    shares = {name: float(sampling_mass(w, demonstrations)[marked].sum()) for name, w in weights.items()}
    return shares | {"auroc": float(roc_auc_score(marked, scores))}


class TransferabilityStage(Stage):
    """A job per cluster and training, each with its own checkpoint and artifact; empty clusters have none."""

    name = "transferability"
    version = 1
    inputs = ("demonstrations", "clustering")

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the section and the imitator's environment."""
        return config.transferability.model_dump(mode="json") | {"environment": config.environment.model_dump()}

    def job_settings(self, config: RunConfig) -> dict[str, Any]:
        """Return what the trainings depend on; reading their scores in another way does not train again."""
        section = config.transferability
        return {
            "gail": section.gail.model_dump(mode="json"),
            "num_scores": section.num_scores,
            "final_steps": section.final_steps,
            "environment": config.environment.model_dump(),
        }

    def jobs(self, run: Run) -> list[str]:
        """Return the jobs of each cluster that has demonstrations, named by the cluster's id."""
        clusters = [f"cluster-{k}" for k in np.unique(_labels(run))]
        again = range(2, run.config.transferability.num_trainings + 1)
        return clusters + [f"{cluster}-training-{n}" for n in again for cluster in clusters]

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Imitate one cluster in the imitator's environment and score its demonstrations along the way."""
        from oodil.pipeline.training import Probe, train

        config, gail = run.config, run.config.transferability.gail
        cluster = ClusterJob.of(run, job)
        reward, demonstrations = cluster.reward, cluster.demonstrations
        probe = Probe("logits", config.transferability.num_scores, lambda: reward.mean_logits(demonstrations))
        history = train(cluster.learner, config.environment, gail, [probe], context, self.checkpoints(run, job))
        env_steps = int(history.steps("logits")[-1]) + cluster.settle(context)
        history.append("logits", env_steps, reward.mean_logits(demonstrations))
        discriminator = {name: value.numpy() for name, value in reward.discriminator.state_dict().items()}
        return {
            _JOB_FILE: encode_arrays(
                {
                    "demonstrations": cluster.members.astype(np.int64),
                    "env_steps": history.steps("logits"),
                    "logits": history.values("logits"),
                }
            ),
            "discriminator.safetensors": encode_arrays(discriminator),
            "policy.safetensors": encode_arrays(cluster.learner.behavior_policy().arrays()),
        }

    def combine(self, run: Run) -> Files:
        """Read each job's scores, turn them into weights, and say how well the sources are told apart."""
        config = run.config
        demonstrations = load_demonstrations(run)
        logits = np.full(len(demonstrations), np.nan)
        history = {}
        trainings: dict[int, list[dict[str, np.ndarray]]] = {}
        for job in self.jobs(run):
            trainings.setdefault(_cluster(job), []).append(run.job_artifact(self.name, job).arrays(_JOB_FILE))
        for cluster, trained in trainings.items():
            # What one imitator can reproduce is transferable, whatever another made of it.
            closest = min(trained, key=lambda arrays: float(arrays["logits"][-1].mean()))
            logits[closest["demonstrations"]] = closest["logits"][-1]
            history[f"cluster_{cluster}/env_steps"] = closest["env_steps"]
            history[f"cluster_{cluster}/scores"] = transferability_of_logits(closest["logits"])
            history[f"cluster_{cluster}/demonstrations"] = closest["demonstrations"]
        horizon = make_batch(config.environment.id, config.environment.dynamics, 1).max_episode_steps
        scores = transferability_of_logits(logits) * share_lasted(demonstrations, horizon)
        sharpening = config.transferability.sharpening
        weights = sharpened_weights(scores, sharpening)
        arrays = {"scores": scores, "weights": weights, "clusters": _labels(run)}
        summary: dict[str, Any] = {
            "env_steps": sum(int(each["env_steps"][-1]) for trained in trainings.values() for each in trained),
            "sharpening": sharpening,
            "mean_score_by_source": {
                label: float(scores[demonstrations.sources == i].mean())
                for i, label in enumerate(demonstrations.source_labels)
            },
        } | told_apart(config, scores, demonstrations)
        return {
            "transferability.safetensors": encode_arrays(arrays),
            "history.safetensors": encode_arrays(history),
            "summary.json": encode_json(summary),
        }


def _cluster(job: str) -> int:
    return int(job.split("-")[1])


def _labels(run: Run) -> np.ndarray:
    return run.artifact("clustering").arrays("assignment.safetensors")["labels"]


register(TransferabilityStage())
