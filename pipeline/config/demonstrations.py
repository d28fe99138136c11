"""What is imitated: demonstrators, or a file."""

from pathlib import Path
from typing import Literal

from pydantic import Field, PositiveInt, model_validator

from oodil.pipeline.config.sections import Dynamics, Section, UnitInterval


class SourceConfig(Section):
    """One demonstrator: its dynamics, its expert and how many of its demonstrations are used."""

    label: str
    """Its name in reports."""
    dynamics: Dynamics = Field(default={})
    """Keyword arguments of the environment: the demonstrator's own dynamics; see `environment.dynamics`."""
    expert: Literal["hand-written"] | Path
    """Folder of a saved expert, relative to the configuration file, or the controller that the environment brings."""
    expert_discount: UnitInterval = 0.995
    """Discount with which its expert is trained; flights are long under low gravity and want a longer horizon."""
    count: PositiveInt
    """Demonstrations to collect."""
    transferable: bool | None = None
    """Whether the imitator can reproduce it, if known: for the report and the oracle, never an input of the method."""

    @property
    def expert_folder(self) -> Path | None:
        """The folder of a saved expert; None for a hand-written controller."""
        return self.expert if isinstance(self.expert, Path) else None


class DemonstrationsConfig(Section):
    """Where the demonstrations come from: a file, or saved experts."""

    file: Path | None = None
    """A saved set, relative to the configuration file."""
    sources: tuple[SourceConfig, ...] = ()
    """Demonstrators to collect from."""
    deterministic: bool = False
    """Collect with mean actions instead of sampled ones."""
    full_length_only: bool = True
    """Keep only episodes that last to the time limit, as the paper does."""
    minimum_return: float | None = None
    """Keep only episodes with at least this true return in the demonstrator's own environment. However it ended, such
    an episode has not failed."""

    @model_validator(mode="after")
    def _one_origin(self) -> "DemonstrationsConfig":
        if (self.file is None) == (not self.sources):
            raise ValueError("give either file or sources")
        labels = [source.label for source in self.sources]
        if len(set(labels)) != len(labels):
            raise ValueError(f"two sources have the same label: {labels}")
        return self
