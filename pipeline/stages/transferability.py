"""Stage 3: one independent GAIL job per cluster; what its discriminators say of every demonstration (Eqn 5 and 6).

The scores are read from each job's discriminator after it has gone on learning for a while against the finished
imitator. The true reward plays no part.
"""

from typing import Any

import numpy as np

from pipeline.algorithms.transferability import (
    sampling_mass,
    share_lasted,
    sharpened_weights,
    transferability,
)
from pipeline.artifacts import Files, encode_arrays, encode_json
from pipeline.config import RunConfig
from pipeline.environments import make_batch
from pipeline.seeding import derive_key, torch_seed
from pipeline.stage import JobContext, Run, Stage
from pipeline.stages.demonstrations import load_demonstrations, transferable_mask

_JOB_FILE = "scores.safetensors"


class TransferabilityStage(Stage):
    """K jobs, each with its own checkpoint and artifact; empty clusters have no job."""

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
        """Return one job per cluster that has demonstrations, named by the cluster's id."""
        return [f"cluster-{k}" for k in np.unique(_labels(run))]

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Imitate one cluster in the imitator's environment and score its demonstrations along the way."""
        from pipeline.algorithms.gail import AdversarialReward
        from pipeline.algorithms.learner import Learner
        from pipeline.training import Probe, experience, train

        config = run.config
        section = config.transferability
        members = np.flatnonzero(_labels(run) == int(job.removeprefix("cluster-")))
        demonstrations = load_demonstrations(run).select(members)
        seed = torch_seed(derive_key(config.seed, self.name, job))
        simulators = make_batch(config.environment.id, config.environment.dynamics, 1)
        reward = AdversarialReward(demonstrations, np.ones(len(members)), section.gail.discriminator, seed)
        learner = Learner(simulators.observation_dim, simulators.action_dim, section.gail, reward, seed)
        probe = Probe("logits", section.num_scores, lambda: reward.mean_logits(demonstrations))
        history = train(learner, config.environment, section.gail, [probe], context, self.checkpoints(run, job))
        policy = learner.behaviour_policy()
        rollouts = experience(policy, config.environment, section.gail, simulators.max_episode_steps, seed, context)
        reward.settle(rollouts, section.final_steps, section.gail.steps_per_iteration)
        env_steps = int(history.steps("logits")[-1]) + sum(rollout.terminated.size for rollout in rollouts)
        history.append("logits", env_steps, reward.mean_logits(demonstrations))
        discriminator = {name: value.numpy() for name, value in reward.discriminator.state_dict().items()}
        return {
            _JOB_FILE: encode_arrays(
                {
                    "demonstrations": members.astype(np.int64),
                    "env_steps": history.steps("logits"),
                    "logits": history.values("logits"),
                }
            ),
            "discriminator.safetensors": encode_arrays(discriminator),
            "policy.safetensors": encode_arrays(policy.arrays()),
        }

    def combine(self, run: Run) -> Files:
        """Read each job's scores, turn them into weights, and say how well the sources are told apart."""
        config = run.config
        demonstrations = load_demonstrations(run)
        logits = np.full(len(demonstrations), np.nan)
        history = {}
        for job in self.jobs(run):
            arrays = run.job_artifact(self.name, job).arrays(_JOB_FILE)
            logits[arrays["demonstrations"]] = arrays["logits"][-1]
            cluster = job.replace("-", "_")
            history[f"{cluster}/env_steps"] = arrays["env_steps"]
            history[f"{cluster}/scores"] = transferability(arrays["logits"])
            history[f"{cluster}/demonstrations"] = arrays["demonstrations"]
        horizon = make_batch(config.environment.id, config.environment.dynamics, 1).max_episode_steps
        scores = transferability(logits) * share_lasted(demonstrations, horizon)
        sharpening = config.transferability.sharpening
        weights = sharpened_weights(scores, sharpening)
        arrays = {"scores": scores, "weights": weights, "clusters": _labels(run)}
        summary: dict[str, Any] = {
            "sharpening": sharpening,
            "mean_score_by_source": {
                label: float(scores[demonstrations.sources == i].mean())
                for i, label in enumerate(demonstrations.source_labels)
            },
        }
        marked = transferable_mask(config, demonstrations)
        if marked is not None and 0 < marked.sum() < len(marked):
            from sklearn.metrics import roc_auc_score

            shares = {
                "transferable_share_before": np.ones(len(demonstrations)),
                "transferable_share_unsharpened": scores,
                "transferable_share": weights,
            }
            summary |= {name: float(sampling_mass(w, demonstrations)[marked].sum()) for name, w in shares.items()}
            summary["auroc"] = float(roc_auc_score(marked, scores))
        return {
            "transferability.safetensors": encode_arrays(arrays),
            "history.safetensors": encode_arrays(history),
            "summary.json": encode_json(summary),
        }


def _labels(run: Run) -> np.ndarray:
    return run.artifact("clustering").arrays("assignment.safetensors")["labels"]
