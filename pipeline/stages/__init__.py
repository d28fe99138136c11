"""The stages; which of them a run has follows from its configuration.

Importing this package registers them. A stage loads what it computes with inside ``run_job``, so that reading a run, or
starting one, does not wait for torch.
"""

import importlib
from collections.abc import Collection

from oodil.pipeline.config import RunConfig
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.stage import Stage, registered, stage_named
from oodil.pipeline.stages import (
    clustering,
    demonstrations,
    experts,
    feasibility,
    finetuning,
    imitation,
    imitators,
    inverse_dynamics,
    marks,
    oracle_target,
    policies,
    reproducibility,
    transferability,
)
from oodil.pipeline.stages.policies import PolicyStage
from oodil.pipeline.stages.weighting import Weighting

__all__ = [
    "PolicyStage",
    "Weighting",
    "clustering",
    "demonstrations",
    "experts",
    "feasibility",
    "finetuning",
    "imitation",
    "imitators",
    "inverse_dynamics",
    "marks",
    "needed_for",
    "oracle_target",
    "policies",
    "policies_of",
    "reproducibility",
    "stages",
    "transferability",
    "weightings_of",
]


def stages(config: RunConfig) -> list[Stage]:
    """Return the stages of a run, each after those it reads from. Raises ConfigError for a policy that is not known."""
    found: dict[str, Stage] = {}

    def add(name: str) -> None:
        stage = stage_named(name)
        for needed in stage.inputs:
            add(needed)
        found.setdefault(name, stage)

    if config.finetuning.run is not None:
        add("finetuning")
        return list(found.values())
    if config.reproducibility is not None:
        add("reproducibility")  # It takes a minute, so it comes before everything that takes longer.
    for entry in ("imitation", *config.baselines):
        module, _, name = entry.rpartition(":")
        if module:
            try:
                importlib.import_module(module)
            except ModuleNotFoundError as error:
                raise ConfigError(f"baselines: {entry!r} cannot be loaded: {error}") from error
        known = [stage.name for stage in registered() if isinstance(stage, PolicyStage) and stage.name != "finetuning"]
        if name not in known:
            raise ConfigError(f"baselines: no policy {name!r}; there are {', '.join(sorted(known))}")
        add(name)
    return list(found.values())


def needed_for(config: RunConfig, names: Collection[str]) -> list[Stage]:
    """Return the stages of a run with these names and all that they follow from, each after those it reads from."""
    every, needed = stages(config), set(names)
    for stage in reversed(every):
        if stage.name in needed:
            needed.update(stage.inputs)
    return [stage for stage in every if stage.name in needed]


def policies_of(config: RunConfig) -> list[PolicyStage]:
    """Return the policies of a run, ours first."""
    return [stage for stage in stages(config) if isinstance(stage, PolicyStage)]


def weightings_of(config: RunConfig) -> list[Weighting]:
    """Return the weightings of a run, ours first."""
    return [stage for stage in stages(config) if isinstance(stage, Weighting)]
