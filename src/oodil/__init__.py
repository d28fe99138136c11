"""Imitation learning from demonstrators whose dynamics differ from your own robot's.

The public interface; everything is loaded when it is first used, so that ``import oodil`` takes no time:

>>> import oodil
>>> results = oodil.run("quickstart", workers=2)  # doctest: +SKIP
>>> results.transferability.table()  # doctest: +SKIP
>>> action = results.policy().act(observation)  # doctest: +SKIP
"""

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from oodil.api import evaluate, finetune, open_run, run, score
    from oodil.orchestrator import Observer
    from oodil.pipeline.config import RunConfig
    from oodil.pipeline.data import Demonstrations
    from oodil.pipeline.datasets import read_demonstrations
    from oodil.pipeline.errors import OodilError, UnfinishedError
    from oodil.pipeline.loading import load_config, shipped_configs
    from oodil.pipeline.report import write_report
    from oodil.pipeline.results import (
        Assignment,
        ClusterDiagnostics,
        Evaluation,
        LearningCurve,
        Policy,
        Reproducibility,
        Transferability,
    )
    from oodil.pipeline.runs import RunResults
    from oodil.pipeline.scoring import Scored
    from oodil.pipeline.stage import register
    from oodil.pipeline.stages import PolicyStage, Weighting

__version__ = "0.1.0"

__all__ = [
    "Assignment",
    "ClusterDiagnostics",
    "Demonstrations",
    "Evaluation",
    "LearningCurve",
    "Observer",
    "OodilError",
    "Policy",
    "PolicyStage",
    "Reproducibility",
    "RunConfig",
    "RunResults",
    "Scored",
    "Transferability",
    "UnfinishedError",
    "Weighting",
    "evaluate",
    "finetune",
    "load_config",
    "open_run",
    "read_demonstrations",
    "register",
    "run",
    "score",
    "shipped_configs",
    "write_report",
]

_HOMES = {
    "oodil.api": ("evaluate", "finetune", "open_run", "run", "score"),
    "oodil.orchestrator": ("Observer",),
    "oodil.pipeline.config": ("RunConfig",),
    "oodil.pipeline.data": ("Demonstrations",),
    "oodil.pipeline.datasets": ("read_demonstrations",),
    "oodil.pipeline.errors": ("OodilError", "UnfinishedError"),
    "oodil.pipeline.loading": ("load_config", "shipped_configs"),
    "oodil.pipeline.report": ("write_report",),
    "oodil.pipeline.results": (
        "Assignment",
        "ClusterDiagnostics",
        "Evaluation",
        "LearningCurve",
        "Policy",
        "Reproducibility",
        "Transferability",
    ),
    "oodil.pipeline.runs": ("RunResults",),
    "oodil.pipeline.scoring": ("Scored",),
    "oodil.pipeline.stage": ("register",),
    "oodil.pipeline.stages": ("PolicyStage", "Weighting"),
}


if "gymnasium" in sys.modules:
    # Gymnasium loads no plugins by itself; whoever has it loaded wants our environments, too, and nobody else waits.
    import_module("oodil.pipeline.environments.registration").register_environments()


def __getattr__(name: str) -> Any:
    """Load a public name when it is first used."""
    for module, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(module), name)
            return value
    raise AttributeError(f"module 'oodil' has no attribute {name!r}")


def __dir__() -> list[str]:
    """List what is public."""
    return sorted([*__all__, "__version__"])
