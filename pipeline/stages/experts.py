"""Training the experts of a configuration: a stage of its own, run by ``oodil demos collect --train`` alone.

A training that gets stuck is started again with the next seed, until its episodes last. This selection, like the
training itself, uses the true reward, as making a demonstrator does; no later stage sees it.
"""

from typing import Any

from pipeline.artifacts import Files, encode_json, write_artifact
from pipeline.config import EnvironmentConfig, RunConfig
from pipeline.evaluation import evaluate
from pipeline.experts import EXPERT_TRAINING, expert_files, train_expert
from pipeline.policy import GaussianPolicy
from pipeline.seeding import derive_key
from pipeline.stage import JobContext, Run, Stage
from pipeline.versions import library_versions

MAX_TRAININGS = 4
"""Seeds tried per source; the best is kept if none lasts."""
EVALUATION_EPISODES = 64
REQUIRED_FULL_SHARE = 0.95
"""Share of sampled episodes that must last to the time limit."""


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
        """Return a job per source."""
        return [f"source-{i}" for i in range(len(run.config.demonstrations.sources))]

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Train until episodes last, and say what the expert reaches with sampled and with mean actions."""
        source = run.config.demonstrations.sources[int(job.removeprefix("source-"))]
        environment = EnvironmentConfig(id=run.config.environment.id, dynamics=source.dynamics)
        training = EXPERT_TRAINING.model_copy(update={"discount": source.expert_discount})
        best: tuple[float, Files] = (-1.0, {})
        for seed in range(run.config.seed, run.config.seed + MAX_TRAININGS):
            policy = train_expert(environment, training, seed, context, self.checkpoints(run, f"{job}-seed-{seed}"))
            reached = _reached(policy, environment, seed)
            described = {"environment": environment.model_dump(), "training": training.model_dump(mode="json")}
            share = reached["stochastic"]["full_length_share"]
            if share > best[0]:
                best = share, expert_files(policy, described | reached | {"seed": seed})
            if share >= REQUIRED_FULL_SHARE:
                break
            context.warn(f"{source.label}, seed {seed}: only {share:.0%} of sampled episodes last")
        return best[1]

    def combine(self, run: Run) -> Files:
        """List the experts."""
        labels = [source.label for source in run.config.demonstrations.sources]
        return {"experts.json": encode_json(dict(zip(self.jobs(run), labels, strict=True)))}

    def export(self, run: Run) -> list[str]:
        """Save each source's expert in its folder; return a line about each."""
        lines = []
        for job, source in zip(self.jobs(run), run.config.demonstrations.sources, strict=True):
            trained = run.job_artifact(self.name, job)
            files = {name: trained.read(name) for name in trained.hashes}
            write_artifact(source.expert, {"expert": source.dynamics}, files, library_versions())
            reached = trained.json("expert.json")["stochastic"]
            lines.append(
                f"{source.label}: return {reached['return_mean']:,.0f} ± {reached['return_std']:,.0f}, "
                f"{reached['full_length_share']:.0%} of sampled episodes last -> {source.expert}"
            )
        return lines


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
