"""Experts: policies trained on the true reward of a demonstrator's dynamics, and the demonstrations they give.

This is the only place where the environment's reward is learned from. A saved expert is an artifact folder with the
policy and, beside it, what it reaches.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from oodil.pipeline.artifacts import Artifact, Checkpoints, Files, encode_arrays, encode_json, read_artifact
from oodil.pipeline.config import EnvironmentConfig, PpoConfig, TrainingConfig, ValueConfig
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.environments import Simulators, make_batch
from oodil.pipeline.errors import DamagedArtifactError, DataError, ExpertError
from oodil.pipeline.evaluation import run_episodes
from oodil.pipeline.policy import Controller, GaussianPolicy
from oodil.pipeline.seeding import derive_key, numpy_rng
from oodil.pipeline.stage import JobContext

EXPERT_TRAINING = TrainingConfig(
    total_steps=2_500_000,
    num_groups=4,
    simulators_per_group=16,
    steps_per_rollout=64,
    lag=0,
    discount=0.995,
    gae_lambda=0.97,
    normalize_observations=True,
    scale_rewards=True,
    policy_optimizer=PpoConfig(learning_rate=1e-3, epochs=5, minibatch_size=512),
    value=ValueConfig(learning_rate=1e-3, epochs=5, minibatch_size=512),
    num_evaluations=0,
)
"""What an expert is trained with unless its source says otherwise."""

COLLECTION_SIMULATORS = 16
"""Episodes collected side by side; part of what the demonstrations depend on."""


def train_expert(
    environment: EnvironmentConfig, config: TrainingConfig, seed: int, context: JobContext, checkpoints: Checkpoints
) -> GaussianPolicy:
    """Train one expert on the environment's reward."""
    from oodil.pipeline.algorithms.learner import EnvReward, Learner
    from oodil.pipeline.training import train

    simulators = make_batch(environment.id, environment.dynamics, 1)
    learner = Learner(simulators.observation_dim, simulators.action_dim, config, EnvReward(), seed)
    train(learner, environment, config, [], context, checkpoints)
    return learner.behavior_policy()


def expert_files(policy: GaussianPolicy, description: dict[str, Any]) -> Files:
    """Return the files of a saved expert; ``description`` says for what it was trained and what it reaches."""
    return {"policy.safetensors": encode_arrays(policy.arrays()), "expert.json": encode_json(description)}


def load_expert(path: Path) -> tuple[GaussianPolicy, Artifact]:
    """Return a saved expert's policy and its artifact. Raises ExpertError unless it is there and sound."""
    try:
        artifact = read_artifact(path)
        if artifact is None:
            raise ExpertError(f"{path}: no expert is saved here")
        return GaussianPolicy.from_arrays(artifact.arrays("policy.safetensors")), artifact
    except (DamagedArtifactError, ValueError) as error:
        raise ExpertError(str(error)) from error


def hand_written(simulators: Simulators, env_id: str) -> Controller:
    """Return the controller that an environment brings along. Raises ExpertError if it brings none."""
    if not hasattr(simulators, "demonstrator"):
        raise ExpertError(f"{env_id} brings no hand-written controller; name the folder of a saved expert")
    controller: Controller = simulators.demonstrator()
    return controller


def collect_demonstrations(
    policy: GaussianPolicy | None,
    environment: EnvironmentConfig,
    label: str,
    count: int,
    seed: int,
    *,
    deterministic: bool,
    full_length_only: bool,
    minimum_return: float | None,
    context: JobContext,
) -> tuple[Demonstrations, float]:
    """Collect ``count`` demonstrations and return them with the share of episodes that were kept.

    Without a policy, the environment's hand-written controller acts; it does as it does, ``deterministic`` or not.

    Raises DataError when fewer than one episode in ten can be kept.
    """
    simulators = make_batch(environment.id, environment.dynamics, COLLECTION_SIMULATORS)
    controller = policy or hand_written(simulators, environment.id)
    kept: list[Episode] = []
    rounds = 0
    while len(kept) < count:
        rounds += 1
        key = derive_key(seed, "demonstrations", label, rounds)
        stochastic = policy is not None and not deterministic
        episodes = run_episodes(simulators, controller, numpy_rng(key), stochastic=stochastic)
        if full_length_only:
            episodes = [each for each in episodes if len(each.states) == simulators.max_episode_steps + 1]
        if minimum_return is not None:
            episodes = [replace(each, terminated=False) for each in episodes if each.env_return >= minimum_return]
        kept += episodes
        if len(kept) * 10 < rounds * COLLECTION_SIMULATORS:
            raise DataError(
                f"source {label!r}: only {len(kept)} of {rounds * COLLECTION_SIMULATORS} episodes can be kept "
                f"(full_length_only: {full_length_only}, minimum_return: {minimum_return}); train a better expert or "
                "ask for less"
            )
        context.progress(min(len(kept), count), count)
    share = len(kept) / (rounds * COLLECTION_SIMULATORS)
    return Demonstrations.of(kept[:count], label), share
