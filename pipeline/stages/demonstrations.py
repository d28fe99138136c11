"""Stage 1: the demonstrations, collected from saved experts (one job per source) or read from a file."""

import hashlib
import re
from typing import Any

import numpy as np

from oodil.pipeline.artifacts import Files, encode_json
from oodil.pipeline.config import EnvironmentConfig, RunConfig, SourceConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.datasets import decode_demonstrations, encode_demonstrations, read_demonstrations
from oodil.pipeline.environments import make_batch
from oodil.pipeline.errors import DataError
from oodil.pipeline.experts import collect_demonstrations, hand_written, load_expert
from oodil.pipeline.stage import JobContext, Run, Stage, register

FILE = "demonstrations.safetensors"


class DemonstrationsStage(Stage):
    """Collects or reads; the files are ``demonstrations.safetensors`` and ``demonstrations.json``."""

    name = "demonstrations"
    version = 1
    inputs = ()

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the sources with the content of their experts, or the content of the file."""
        section = config.demonstrations
        common = {"environment": config.environment.id, "own_dynamics": config.environment.dynamics}
        if section.file is not None:
            return common | {"file_sha256": hashlib.sha256(section.file.read_bytes()).hexdigest()}
        sources = [
            source.model_dump(mode="json", exclude={"expert"}) | {"expert_sha256": _identity(source)}
            for source in section.sources
        ]
        flags = section.model_dump(include={"deterministic", "full_length_only", "minimum_return"})
        return common | flags | {"sources": sources}

    def jobs(self, run: Run) -> list[str]:
        """Return one job per source, or the stage itself for a file."""
        sources = run.config.demonstrations.sources
        return [_job_name(i, source) for i, source in enumerate(sources)] or [self.name]

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Collect from one source, or take over the file."""
        config = run.config
        section = config.demonstrations
        if section.file is not None:
            demonstrations, _ = read_demonstrations(section.file)
            return _files(demonstrations, config, {})
        names = self.jobs(run)
        source = section.sources[names.index(job)]
        environment = EnvironmentConfig(id=config.environment.id, dynamics=source.dynamics)
        demonstrations, kept = collect_demonstrations(
            None if isinstance(source.expert, str) else load_expert(source.expert)[0],
            environment,
            source.label,
            source.count,
            config.seed,
            deterministic=section.deterministic,
            full_length_only=section.full_length_only,
            minimum_return=section.minimum_return,
            context=context,
        )
        return {
            FILE: encode_demonstrations(demonstrations, config.environment.id),
            "source.json": encode_json({"label": source.label, "kept_share": kept}),
        }

    def combine(self, run: Run) -> Files | None:
        """Join the sources, in the order of the configuration."""
        sources = run.config.demonstrations.sources
        if not sources:
            return None
        parts, kept = [], {}
        for job in self.jobs(run):
            artifact = run.job_artifact(self.name, job)
            parts.append(decode_demonstrations(artifact.read(FILE), str(artifact.path / FILE))[0])
            described = artifact.json("source.json")
            kept[described["label"]] = described["kept_share"]
        return _files(Demonstrations.joined(parts), run.config, kept)


def load_demonstrations(run: Run) -> Demonstrations:
    """Return the demonstrations of a run whose first stage is finished."""
    artifact = run.artifact(DemonstrationsStage.name)
    return decode_demonstrations(artifact.read(FILE), str(artifact.path / FILE))[0]


def transferable_mask(config: RunConfig, demonstrations: Demonstrations) -> np.ndarray | None:
    """Return (N,) whether each demonstration's source is marked transferable; None unless every source is marked."""
    marks = [source.transferable for source in config.demonstrations.sources]
    if not marks or None in marks:
        return None
    return np.array(marks, np.bool_)[demonstrations.sources]


def check_demonstrations(config: RunConfig, observation_dim: int) -> None:
    """Raise DataError or ExpertError, before any work, if the demonstrations cannot fit the environment."""
    section = config.demonstrations
    if section.file is not None:
        demonstrations, environment = read_demonstrations(section.file)
        if demonstrations.observation_dim != observation_dim:
            raise DataError(
                f"{section.file}: states have {demonstrations.observation_dim} dimensions; "
                f"environment {config.environment.id} has {observation_dim}"
            )
        if environment and environment != config.environment.id:
            raise DataError(f"{section.file}: recorded in {environment}, but the run is for {config.environment.id}")
    for source in section.sources:
        if isinstance(source.expert, str):
            hand_written(make_batch(config.environment.id, source.dynamics, 1), config.environment.id)
            continue
        policy, _ = load_expert(source.expert)
        if len(policy.input_mean) != observation_dim:
            raise DataError(
                f"{source.expert}: the expert sees {len(policy.input_mean)} dimensions; "
                f"environment {config.environment.id} has {observation_dim}"
            )


def _identity(source: SourceConfig) -> str:
    return source.expert if isinstance(source.expert, str) else load_expert(source.expert)[1].sha256


def _job_name(index: int, source: SourceConfig) -> str:
    return f"{index}-{re.sub(r'[^A-Za-z0-9.]+', '-', source.label).strip('-')}"


def _files(demonstrations: Demonstrations, config: RunConfig, kept: dict[str, float]) -> Files:
    described = {
        "environment": config.environment.model_dump(mode="json"),
        "source_labels": demonstrations.source_labels,
        "transferable": [source.transferable for source in config.demonstrations.sources]
        or [None] * len(demonstrations.source_labels),
        "source_dynamics": [source.dynamics for source in config.demonstrations.sources],
        "kept_share": kept,
    }
    return {
        FILE: encode_demonstrations(demonstrations, config.environment.id),
        "demonstrations.json": encode_json(described),
    }


register(DemonstrationsStage())
