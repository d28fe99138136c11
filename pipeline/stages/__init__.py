"""The stages, in order; which of them a run has follows from its configuration.

A stage loads what it computes with inside ``run_job``, so that reading a run, or starting one, does not wait for torch.
"""

from oodil.pipeline.config import RunConfig
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.stage import Stage
from oodil.pipeline.stages.clustering import ClusteringStage
from oodil.pipeline.stages.demonstrations import DemonstrationsStage
from oodil.pipeline.stages.experts import ExpertsStage
from oodil.pipeline.stages.imitation import ImitationStage, NaiveGailStage, OracleStage
from oodil.pipeline.stages.transferability import TransferabilityStage


def stages(config: RunConfig) -> list[Stage]:
    """Return the stages of a run, each after those it reads from."""
    baselines: dict[str, Stage] = {stage.name: stage for stage in (NaiveGailStage(), OracleStage())}
    method: list[Stage] = [DemonstrationsStage(), ClusteringStage(), TransferabilityStage(), ImitationStage()]
    return method + [baselines[name] for name in config.baselines]


def stage_named(config: RunConfig, name: str) -> Stage:
    """Return a stage of the run by its name. Raises ConfigError, naming those there are, if there is none."""
    for stage in (*stages(config), ExpertsStage()):
        if stage.name == name:
            return stage
    raise ConfigError(f"no stage {name!r}; this run has {', '.join(stage.name for stage in stages(config))}")
