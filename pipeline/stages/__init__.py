"""The stages, in order; which of them a run has follows from its configuration.

A stage loads what it computes with inside ``run_job``, so that reading a run, or starting one, does not wait for torch.
"""

from oodil.pipeline.config import RunConfig
from oodil.pipeline.stage import Stage, stage_named
from oodil.pipeline.stages import clustering, demonstrations, experts, imitation, transferability

__all__ = ["clustering", "demonstrations", "experts", "imitation", "stages", "transferability"]


def stages(config: RunConfig) -> list[Stage]:
    """Return the stages of a run, each after those it reads from."""
    found: dict[str, Stage] = {}

    def add(name: str) -> None:
        stage = stage_named(name)
        for needed in stage.inputs:
            add(needed)
        found.setdefault(name, stage)

    for name in ("imitation", *config.baselines):
        add(name)
    return list(found.values())
