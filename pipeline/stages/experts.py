"""Experts: policies trained on the true reward of a demonstrator's dynamics; the only place that learns from it.

The stage is run by ``oodil demos collect --train`` alone. Each source gets two independent trainings, and the one with
the higher sampled return is kept, because one that falls has a low one. A saved expert is an artifact folder with the
policy and what it reaches; only a better one replaces it.
"""

from math import nan
from pathlib import Path
from typing import Any

from oodil.pipeline.artifacts import (
    Artifact,
    Checkpoints,
    Files,
    encode_arrays,
    encode_json,
    read_artifact,
    write_artifact,
)
from oodil.pipeline.config import EnvironmentConfig, PpoConfig, RunConfig, SourceConfig, TrainingConfig, ValueConfig
from oodil.pipeline.environments import environment_spec
from oodil.pipeline.errors import DamagedArtifactError, ExpertError
from oodil.pipeline.evaluation import evaluate
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.results import Evaluation
from oodil.pipeline.seeding import Key, derive_key
from oodil.pipeline.stage import Cost, JobContext, Run, Stage, register
from oodil.pipeline.versions import library_versions

TRAININGS = 2
"""Seeds tried per source."""
EVALUATION_EPISODES = 64
TRANSFER_EPISODES = 8
"""Episodes of each source's expert under the imitator's own dynamics."""


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
)
"""What an expert is trained with unless its source says otherwise."""


class ExpertsStage(Stage):
    """One job per source; `export` saves the experts where the configuration looks for them."""

    name = "experts"
    version = 2
    inputs = ()

    def check(self, config: RunConfig) -> None:
        """Raise ExpertError if a source's folder holds the expert of another environment."""
        for source in config.demonstrations.sources:
            if saved := _saved(source):
                described = saved[1].json("expert.json").get("environment", {})
                found = described.get("id", config.environment.id)
                if found != config.environment.id:
                    raise ExpertError(f"{source.expert}: holds an expert of {found}, not of {config.environment.id}")

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return what the trainings depend on."""
        sources = {
            str(i): source.model_dump(mode="json", include={"dynamics", "expert_discount"})
            for i, source in enumerate(config.demonstrations.sources)
        }
        training = EXPERT_TRAINING.model_dump(mode="json")
        return {"environment": config.environment.id, "sources": sources, "training": training}

    def cost(self, config: RunConfig) -> Cost:
        """Return the cost of all trainings."""
        jobs = TRAININGS * sum(source.expert_folder is not None for source in config.demonstrations.sources)
        return Cost.of_training(jobs * EXPERT_TRAINING.total_steps, max(jobs, 1))

    def jobs(self, run: Run) -> list[str]:
        """Return a job per source and seed; hand-written experts have none."""
        seeds = range(run.config.seed, run.config.seed + TRAININGS)
        return [_job(i, seed) for i, _ in self._trained(run) for seed in seeds]

    @staticmethod
    def _trained(run: Run) -> list[tuple[int, SourceConfig]]:
        return [(i, source) for i, source in enumerate(run.config.demonstrations.sources) if source.expert_folder]

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Train one expert and say what it reaches with sampled and with mean actions."""
        _, index, _, seed = job.split("-")
        source = run.config.demonstrations.sources[int(index)]
        environment = EnvironmentConfig(id=run.config.environment.id, dynamics=source.dynamics)
        training = EXPERT_TRAINING.model_copy(update={"discount": source.expert_discount})
        policy = train_expert(environment, training, int(seed), context, self.checkpoints(run, job))
        described = {
            "environment": environment.settings(),
            "training": training.model_dump(mode="json"),
            "seed": int(seed),
        }
        return expert_files(policy, described | _reached(policy, environment, int(seed)))

    def combine(self, run: Run) -> Files:
        """Choose the better training of each source."""
        chosen = {}
        for i, _ in self._trained(run):
            returns = {
                job: run.job_artifact(self.name, job).json("expert.json")["stochastic"]["return_mean"]
                for job in self.jobs(run)
                if job.startswith(f"source-{i}-")
            }
            chosen[str(i)] = max(returns, key=lambda job: returns[job])
        return {"chosen.json": encode_json(chosen)}

    def export(self, run: Run) -> list[str]:
        """Save each source's expert in its folder, unless the one there is as good; return a line about each."""
        chosen = run.artifact(self.name).json("chosen.json")
        key = derive_key(run.config.seed, "expert comparison")
        lines = []
        for i, source in self._trained(run):
            environment = EnvironmentConfig(id=run.config.environment.id, dynamics=source.dynamics)
            trained = run.job_artifact(self.name, chosen[str(i)])
            policy = GaussianPolicy.from_arrays(trained.arrays("policy.safetensors"))
            new = _run(policy, environment, key, stochastic=True)
            saved = _saved(source)
            old = _run(saved[0], environment, key, stochastic=True) if saved else None
            line = f"{source.label}: {_said(new)} -> "
            # Whatever is not better, NaN included, replaces nothing.
            if old and not new.mean_return > old.mean_return:
                lines.append(f"{line}not saved; kept the expert in {source.expert}: {_said(old)}")
                continue
            files = {name: trained.read(name) for name in trained.hashes}
            write_artifact(Path(source.expert), {"expert": source.dynamics}, files, library_versions())
            lines.append(f"{line}{source.expert}" + (f", in place of one: {_said(old)}" if old else ""))
        return lines


def train_expert(
    environment: EnvironmentConfig, config: TrainingConfig, seed: int, context: JobContext, checkpoints: Checkpoints
) -> GaussianPolicy:
    """Train one expert on the environment's reward."""
    from oodil.pipeline.algorithms.learner import EnvReward, Learner
    from oodil.pipeline.training import train

    spec = environment_spec(environment.id, environment.dynamics)
    learner = Learner(spec.observation_dim, spec.action_dim, config, EnvReward(), seed)
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


def transfer_returns(config: RunConfig) -> tuple[float, ...]:
    """Return, by source, what its expert's mean actions return under the imitator's own dynamics; for reporting alone.

    NaN for a hand-written controller, which is made for its own world, and for an expert with other actions.
    """
    target = config.environment
    action_dim = environment_spec(target.id, target.dynamics).action_dim
    key = derive_key(config.seed, "direct transfer")
    returns = []
    for source in config.demonstrations.sources:
        policy = load_expert(source.expert_folder)[0] if source.expert_folder else None
        if policy is None or len(policy.log_std) != action_dim:
            returns.append(nan)
        else:
            returns.append(evaluate(policy, target.id, target.dynamics, TRANSFER_EPISODES, key).mean_return)
    return tuple(returns)


def _job(source: int, seed: int) -> str:
    return f"source-{source}-seed-{seed}"


def _saved(source: SourceConfig) -> tuple[GaussianPolicy, Artifact] | None:
    """Return the sound expert in a source's folder, or None; a damaged one is of no use to anybody."""
    try:
        return load_expert(source.expert_folder) if source.expert_folder else None
    except ExpertError:
        return None


def _said(seen: Evaluation) -> str:
    """Return what sampled episodes came to, in words."""
    lasted = _full_length_share(seen)
    return f"return {seen.mean_return:,.0f} ± {seen.std_return:,.0f}, {lasted:.0%} of sampled episodes last"


def _full_length_share(seen: Evaluation) -> float:
    return float((seen.lengths == seen.lengths.max()).mean())


def _run(policy: GaussianPolicy, environment: EnvironmentConfig, key: Key, *, stochastic: bool) -> Evaluation:
    return evaluate(policy, environment.id, environment.dynamics, EVALUATION_EPISODES, key, stochastic=stochastic)


def _reached(policy: GaussianPolicy, environment: EnvironmentConfig, seed: int) -> dict[str, dict[str, float]]:
    reached = {}
    for name in ("deterministic", "stochastic"):
        seen = _run(policy, environment, derive_key(seed, "expert evaluation"), stochastic=name == "stochastic")
        reached[name] = {
            "episodes": EVALUATION_EPISODES,
            "return_mean": seen.mean_return,
            "return_std": seen.std_return,
            "length_mean": seen.mean_length,
            "full_length_share": _full_length_share(seen),
        }
    return reached


register(ExpertsStage())
