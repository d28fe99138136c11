"""What the stages leave behind, typed: each type knows its files, and nothing else names them or what is in them.

``files()`` gives the content of an artifact, ``load(artifact)`` reads it back, checked against the manifest.
"""

from oodil.pipeline.results.clusters import Assignment, ClusterDiagnostics, cluster_model_files, load_cluster_model
from oodil.pipeline.results.demonstrations import CollectedDemonstrations
from oodil.pipeline.results.following import FeasibilityScale, Following, Reproducibility, Tracker
from oodil.pipeline.results.networks import discriminator_file, load_discriminator, load_value, value_file
from oodil.pipeline.results.policies import (
    Evaluation,
    LearningCurve,
    Policy,
    Training,
    Trainings,
)
from oodil.pipeline.results.scores import Imitator, Reading, ScoreHistory, TrainedImitators, Transferability

__all__ = [
    "Assignment",
    "ClusterDiagnostics",
    "CollectedDemonstrations",
    "Evaluation",
    "FeasibilityScale",
    "Following",
    "Imitator",
    "LearningCurve",
    "Policy",
    "Reading",
    "Reproducibility",
    "ScoreHistory",
    "Tracker",
    "TrainedImitators",
    "Training",
    "Trainings",
    "Transferability",
    "cluster_model_files",
    "discriminator_file",
    "load_cluster_model",
    "load_discriminator",
    "load_value",
    "value_file",
]
