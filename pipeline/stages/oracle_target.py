"""The oracle of the imitator's own dynamics: GAIL on demonstrations of an expert that was trained in them.

They are collected by a stage of their own, and no other stage reads them. Like `oracle`, it is an upper bound, not a
method: without such an expert there would be nothing to transfer.
"""

import json
from typing import Any

from oodil.pipeline.artifacts import Files
from oodil.pipeline.config import ExpertConfig, RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.errors import ConfigError, DataError, ExpertError
from oodil.pipeline.results import CollectedDemonstrations
from oodil.pipeline.stage import JobContext, Run, register, state_of
from oodil.pipeline.stages.demonstrations import CopyStage, check_expert, collect_demonstrations, flags, identity
from oodil.pipeline.stages.experts import load_expert
from oodil.pipeline.stages.policies import PolicyStage


class TargetDemonstrationsStage(CopyStage):
    """Collects from the expert of `oracle_target`, by the same rules as from the sources of a mixture."""

    name = "target_demonstrations"
    version = 1
    inputs = ()

    def check(self, config: RunConfig) -> None:
        """Raise ConfigError unless an expert is named."""
        _section(config)

    def check_files(self, config: RunConfig, observation_dim: int, run: Run | None = None) -> None:
        """Raise DataError or ExpertError, before any work, unless the expert acts in the imitator's own dynamics."""
        if run is not None and state_of(self, run).state == "done":
            return
        section, environment = _section(config), config.environment
        check_expert(section, environment, observation_dim)
        if section.expert_folder is None:
            return
        trained = load_expert(section.expert_folder)[1].json("expert.json").get("environment", {}).get("dynamics")
        if trained is not None and trained != environment.dynamics:
            raise ExpertError(
                f"oracle_target.expert: {section.expert} was trained with {_words(trained)}; "
                f"the imitator has {_words(environment.dynamics)}"
            )

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the imitator's environment, the content of the expert, and what is collected."""
        section = _section(config)
        chosen = {"count": section.count, "expert_sha256": identity(section)}
        return {"environment": config.environment.settings()} | chosen | flags(config.demonstrations)

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Collect in the imitator's environment."""
        section, environment = _section(run.config), run.config.environment
        policy = load_expert(section.expert_folder)[0] if section.expert_folder else None
        rules = flags(run.config.demonstrations)
        try:
            found, kept = collect_demonstrations(
                policy, environment, "target", section.count, run.config.seed, context=context, **rules
            )
        except DataError as error:
            raise DataError(f"oracle_target: {error}") from error
        return CollectedDemonstrations(found, (kept,), environment.id).files()


class TargetOracle(PolicyStage):
    """A policy that learns from `TargetDemonstrationsStage` alone."""

    def __init__(self, name: str, title: str) -> None:
        """Name the policy."""
        super().__init__(name, title, weighting=None)
        self.inputs = (TargetDemonstrationsStage.name,)

    def demonstrations(self, run: Run) -> Demonstrations:
        """Return those of the imitator's own dynamics."""
        return CollectedDemonstrations.load(run.artifact(TargetDemonstrationsStage.name)).demonstrations


def _section(config: RunConfig) -> ExpertConfig:
    if config.oracle_target is None:
        raise ConfigError(
            "baselines: oracle_target learns from an expert of the imitator's own dynamics; name one: "
            "oracle_target: {expert: FOLDER, count: N}"
        )
    return config.oracle_target


def _words(dynamics: dict[str, Any]) -> str:
    return (
        ", ".join(f"{name} {json.dumps(value)}" for name, value in dynamics.items()) or "the dynamics that are default"
    )


register(TargetDemonstrationsStage())
register(TargetOracle("oracle_target", title="target oracle"))
