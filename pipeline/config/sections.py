"""What every section of a configuration has in common."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, PositiveInt

UnitInterval = Annotated[float, Field(ge=0.0, le=1.0)]
Hidden = Annotated[tuple[PositiveInt, ...], Field(min_length=1)]


class Section(BaseModel):
    """A frozen mapping of known fields only."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


class EnvironmentConfig(Section):
    """An environment and its dynamics."""

    id: str = "oodil/Hopper-v0"
    """A Gymnasium id that has a batched form."""
    dynamics: dict[str, float] = {}
    """Keyword arguments of the environment: the imitator's own dynamics."""
