"""Training the experts of a configuration: a stage of its own, run by ``oodil demos collect --train`` alone.

Each source gets two independent trainings, and the one with the higher sampled return is kept; one that falls has a
low one. This selection, like the training itself, uses the true reward, as making a demonstrator does; no later stage
sees it.
"""

from pathlib import Path
from typing import Any

from oodil.pipeline.artifacts import Files, encode_json, write_artifact
from oodil.pipeline.config import EnvironmentConfig, RunConfig, SourceConfig
from oodil.pipeline.evaluation import evaluate
from oodil.pipeline.experts import EXPERT_TRAINING, expert_files, train_expert
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.seeding import derive_key
from oodil.pipeline.stage import JobContext, Run, Stage, register
from oodil.pipeline.versions import library_versions

TRAININGS = 2
"""Seeds tried per source."""
EVALUATION_EPISODES = 64


class ExpertsStage(Stage):
    """One job per source; `export` saves the experts where the configuration looks for them."""

    name = "experts"
    version = 1
    inputs = ()

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return what the trainings depend on."""
        sources = {
            source.label: source.model_dump(mode="json", include={"dynamics", "expert_discount"})
            for source in config.demonstrations.sources
        }
        training = EXPERT_TRAINING.model_dump(mode="json")
        return {"environment": config.environment.id, "sources": sources, "training": training}

    def jobs(self, run: Run) -> list[str]:
        """Return a job per source and seed; hand-written experts have none."""
        seeds = range(run.config.seed, run.config.seed + TRAININGS)
        return [_job(i, seed) for i, _ in self._trained(run) for seed in seeds]

    @staticmethod
    def _trained(run: Run) -> list[tuple[int, SourceConfig]]:
        return [(i, s) for i, s in enumerate(run.config.demonstrations.sources) if not isinstance(s.expert, str)]

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Train one expert and say what it reaches with sampled and with mean actions."""
        _, index, _, seed = job.split("-")
        source = run.config.demonstrations.sources[int(index)]
        environment = EnvironmentConfig(id=run.config.environment.id, dynamics=source.dynamics)
        training = EXPERT_TRAINING.model_copy(update={"discount": source.expert_discount})
        policy = train_expert(environment, training, int(seed), context, self.checkpoints(run, job))
        described = {
            "environment": environment.model_dump(),
            "training": training.model_dump(mode="json"),
            "seed": int(seed),
        }
        return expert_files(policy, described | _reached(policy, environment, int(seed)))

    def combine(self, run: Run) -> Files:
        """Choose the better training of each source."""
        chosen = {}
        for i, source in self._trained(run):
            returns = {
                job: run.job_artifact(self.name, job).json("expert.json")["stochastic"]["return_mean"]
                for job in self.jobs(run)
                if job.startswith(f"source-{i}-")
            }
            chosen[source.label] = max(returns, key=lambda job: returns[job])
        return {"chosen.json": encode_json(chosen)}

    def export(self, run: Run) -> list[str]:
        """Save each source's expert in its folder; return a line about each."""
        chosen = run.artifact(self.name).json("chosen.json")
        lines = []
        for _, source in self._trained(run):
            trained = run.job_artifact(self.name, chosen[source.label])
            files = {name: trained.read(name) for name in trained.hashes}
            write_artifact(Path(source.expert), {"expert": source.dynamics}, files, library_versions())
            reached = trained.json("expert.json")["stochastic"]
            lines.append(
                f"{source.label}: return {reached['return_mean']:,.0f} ± {reached['return_std']:,.0f}, "
                f"{reached['full_length_share']:.0%} of sampled episodes last -> {source.expert}"
            )
        return lines


def _job(source: int, seed: int) -> str:
    return f"source-{source}-seed-{seed}"


def _reached(policy: GaussianPolicy, environment: EnvironmentConfig, seed: int) -> dict[str, dict[str, float]]:
    reached = {}
    for name in ("deterministic", "stochastic"):
        seen = evaluate(
            policy,
            environment.id,
            environment.dynamics,
            EVALUATION_EPISODES,
            derive_key(seed, "expert evaluation"),
            stochastic=name == "stochastic",
        )
        reached[name] = {
            "episodes": EVALUATION_EPISODES,
            "return_mean": float(seen.returns.mean()),
            "return_std": float(seen.returns.std()),
            "length_mean": float(seen.lengths.mean()),
            "full_length_share": float((seen.lengths == seen.lengths.max()).mean()),
        }
    return reached


register(ExpertsStage())
