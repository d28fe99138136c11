"""What is imitated: demonstrators, or a file."""

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, PositiveInt, model_validator

from oodil.pipeline.config.sections import Dynamics, Section, UnitInterval


class ExpertConfig(Section):
    """Who demonstrates, and how often."""

    expert: Literal["hand-written"] | Path
    """Folder of a saved expert, relative to the configuration file, or the controller that the environment brings."""
    count: PositiveInt
    """Demonstrations to collect."""

    @property
    def expert_folder(self) -> Path | None:
        """The folder of a saved expert; None for a hand-written controller."""
        return self.expert if isinstance(self.expert, Path) else None

    def relative_to(self, base: Path) -> Self:
        """Return it with an expert that is found from anywhere: so far its folder is relative to ``base``."""
        return self.model_copy(update={"expert": base / self.expert}) if isinstance(self.expert, Path) else self


class SourceConfig(ExpertConfig):
    """One demonstrator: its dynamics, its expert and how many of its demonstrations are used."""

    label: str
    """Its name in reports."""
    dynamics: Dynamics = Field(default={})
    """Keyword arguments of the environment: the demonstrator's own dynamics; see `environment.dynamics`."""
    expert_discount: UnitInterval = 0.995
    """Discount with which its expert is trained; flights are long under low gravity and want a longer horizon."""
    transferable: bool | None = None
    """Whether the imitator can reproduce it, if known: for the report and the oracle, never an input of the method."""


class DemonstrationsConfig(Section):
    """Where the demonstrations come from: a file, or saved experts."""

    file: Path | None = None
    """A saved set, relative to the configuration file."""
    labels: tuple[str, ...] = ()
    """What the sources of the file are called in reports, in its order; without, as in the file."""
    transferable: tuple[str, ...] = ()
    """Sources of the file, by label, that the imitator is known to be able to reproduce, all others not: for the report
    and the oracle, never an input of the method."""
    unmarked: tuple[str, ...] = ()
    """Sources of the file, by label, of which nothing is known; needs ``transferable``."""
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
        if self.sources and (self.labels or self.transferable or self.unmarked):
            raise ValueError("labels, transferable and unmarked are for a file; each of the sources has its own")
        if self.unmarked and (not self.transferable or {*self.unmarked} & {*self.transferable}):
            raise ValueError("unmarked are other sources than transferable, and need some that are transferable")
        if len(set(self.labels)) != len(self.labels):
            raise ValueError(f"two sources have the same label: {list(self.labels)}")
        labels = [source.label for source in self.sources]
        if len(set(labels)) != len(labels):
            raise ValueError(f"two sources have the same label: {labels}")
        return self
