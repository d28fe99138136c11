"""Training the experts of a configuration: a stage of its own, run by ``oodil demos collect --train`` alone.

Each source gets several independent trainings; the best whose episodes last is kept. This selection, like the training
itself, uses the true reward, as making a demonstrator does; no later stage sees it.
"""

from typing import Any

import numpy as np

from pipeline.artifacts import Files, encode_json, write_artifact
from pipeline.config import EnvironmentConfig, RunConfig
from pipeline.evaluation import evaluate
from pipeline.experts import EXPERT_TRAINING, expert_files, train_expert
from pipeline.seeding import derive_key
from pipeline.stage import JobContext, Run, Stage
from pipeline.versions import library_versions

RESTARTS = 2
"""Independent trainings per source."""
EVALUATION_EPISODES = 64
REQUIRED_FULL_SHARE = 0.95
"""Share of sampled episodes that must last to the time limit."""


class ExpertsStage(Stage):
    """One job per source and restart; `export` saves the best where the configuration looks for them."""

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
        """Return a job per source and restart."""
        sources = range(len(run.config.demonstrations.sources))
        return [f"source-{i}-restart-{r}" for i in sources for r in range(RESTARTS)]

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Train one expert and say what it reaches with sampled and with mean actions."""
        _, index, _, restart = job.split("-")
        source = run.config.demonstrations.sources[int(index)]
        environment = EnvironmentConfig(id=run.config.environment.id, dynamics=source.dynamics)
        training = EXPERT_TRAINING.model_copy(update={"discount": source.expert_discount})
        seed = run.config.seed + int(restart)
        policy = train_expert(environment, training, seed, context, self.checkpoints(run, job))
        key = derive_key(seed, "expert evaluation")
        description: dict[str, Any] = {
            "environment": environment.model_dump(),
            "training": training.model_dump(mode="json"),
            "seed": seed,
        }
        for name in ("deterministic", "stochastic"):
            seen = evaluate(
                policy, environment.id, environment.dynamics, EVALUATION_EPISODES, key, stochastic=name == "stochastic"
            )
            description[name] = {
                "episodes": EVALUATION_EPISODES,
                "return_mean": float(seen.returns.mean()),
                "return_std": float(seen.returns.std()),
                "length_mean": float(seen.lengths.mean()),
                "full_length_share": float((seen.lengths == seen.lengths.max()).mean()),
            }
        return expert_files(policy, description)

    def combine(self, run: Run) -> Files:
        """Choose, per source, the expert with the highest sampled return among those whose episodes last."""
        chosen = {}
        for i, source in enumerate(run.config.demonstrations.sources):
            candidates = [f"source-{i}-restart-{r}" for r in range(RESTARTS)]
            reached = {c: run.job_artifact(self.name, c).json("expert.json")["stochastic"] for c in candidates}
            lasting = [c for c in candidates if reached[c]["full_length_share"] >= REQUIRED_FULL_SHARE]
            ranked = lasting or candidates
            best = ranked[int(np.argmax([reached[c]["return_mean"] for c in ranked]))]
            chosen[source.label] = {"job": best, "lasts": bool(lasting)}
        return {"selection.json": encode_json(chosen)}

    def export(self, run: Run) -> list[str]:
        """Save each source's chosen expert in its folder; return a line about each."""
        lines = []
        for label, choice in run.artifact(self.name).json("selection.json").items():
            source = next(s for s in run.config.demonstrations.sources if s.label == label)
            candidate = run.job_artifact(self.name, choice["job"])
            files = {name: candidate.read(name) for name in candidate.hashes}
            write_artifact(source.expert, {"expert": label, "sha256": candidate.sha256}, files, library_versions())
            reached = candidate.json("expert.json")["stochastic"]
            lines.append(
                f"{label}: return {reached['return_mean']:,.0f} ± {reached['return_std']:,.0f}, "
                f"{reached['full_length_share']:.0%} of sampled episodes last -> {source.expert}"
                + ("" if choice["lasts"] else f"  (below the {REQUIRED_FULL_SHARE:.0%} wanted)")
            )
        return lines
