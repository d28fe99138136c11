"""The configuration: one frozen model, validated once (`oodil.pipeline.loading`), written into the run directory.

Every field has a type, a default where one is sensible, and a line below it. Nothing here imports torch or a simulator.
"""

from oodil.pipeline.config.clustering import CLUSTERING_PRESETS, ClusteringConfig
from oodil.pipeline.config.demonstrations import DemonstrationsConfig, ExpertConfig, SourceConfig
from oodil.pipeline.config.methods import (
    FeasibilityConfig,
    FinetuningConfig,
    ImitationConfig,
    InverseDynamicsConfig,
    ReadingConfig,
    ReproducibilityConfig,
    TransferabilityConfig,
)
from oodil.pipeline.config.run import PRESETS, EvaluationConfig, RunConfig, RuntimeConfig
from oodil.pipeline.config.sections import EnvironmentConfig
from oodil.pipeline.config.training import (
    DiscriminatorConfig,
    GailConfig,
    PpoConfig,
    TrainingConfig,
    TrpoConfig,
    ValueConfig,
)

__all__ = [
    "CLUSTERING_PRESETS",
    "PRESETS",
    "ClusteringConfig",
    "DemonstrationsConfig",
    "DiscriminatorConfig",
    "EnvironmentConfig",
    "EvaluationConfig",
    "ExpertConfig",
    "FeasibilityConfig",
    "FinetuningConfig",
    "GailConfig",
    "ImitationConfig",
    "InverseDynamicsConfig",
    "PpoConfig",
    "ReadingConfig",
    "ReproducibilityConfig",
    "RunConfig",
    "RuntimeConfig",
    "SourceConfig",
    "TrainingConfig",
    "TransferabilityConfig",
    "TrpoConfig",
    "ValueConfig",
]
