"""What every section of a configuration has in common."""

import json
import math
import re
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, JsonValue, PositiveInt, ValidationInfo, field_validator

UnitInterval = Annotated[float, Field(ge=0.0, le=1.0)]
Hidden = Annotated[tuple[PositiveInt, ...], Field(min_length=1)]


class Section(BaseModel):
    """A frozen mapping of known fields only."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


Dynamics = dict[str, JsonValue]
"""Keyword arguments of an environment: whatever JSON holds."""

_WHOLE = ("frame_skip", "max_episode_steps")
"""Dynamics of ours that are whole numbers."""
_LARGEST, _DEEPEST = 16_384, 16
"""Characters of dynamics as JSON, and levels; they travel with every unit of work."""
_NUMBER = re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+")
"""Numbers that YAML 1.1 takes for text, such as 1e-3."""


def is_ours(env_id: str) -> bool:
    """Return whether an environment comes with oodil."""
    return env_id.rpartition(":")[2].startswith("oodil/")


def is_same(env_id: str, other: str) -> bool:
    """Return whether two ids are of one environment: the module that registers it is no part of its name."""
    return env_id.rpartition(":")[2] == other.rpartition(":")[2]


def dynamics_of(env_id: str, dynamics: Dynamics) -> Dynamics:
    """Return dynamics as an environment is given them: those of ours are numbers, and 12 is 12.0.

    Raises ValueError for anything else.
    """
    if is_ours(env_id):
        return {name: _number(name, value) for name, value in dynamics.items()}
    if len(json.dumps(dynamics)) > _LARGEST:
        raise ValueError(f"more than {_LARGEST} characters; let the environment read a file")
    return {name: _as_meant(value, _DEEPEST) for name, value in dynamics.items()}


def _number(name: str, value: Any) -> float | int:
    try:
        found = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} has to be a number in an environment of ours, got {value!r}") from None
    if not math.isfinite(found):
        raise ValueError(f"{name} has to be finite, got {value!r}")
    return int(found) if name in _WHOLE and found.is_integer() else found


def _as_meant(value: Any, depth: int) -> Any:
    if not depth:
        raise ValueError(f"lists or mappings in more than {_DEEPEST} others")
    if isinstance(value, dict):
        return {name: _as_meant(each, depth - 1) for name, each in value.items()}
    if isinstance(value, list):
        return [_as_meant(each, depth - 1) for each in value]
    return float(value) if isinstance(value, str) and _NUMBER.fullmatch(value) else value


class EnvironmentConfig(Section):
    """An environment and its dynamics."""

    id: str = "oodil/Hopper-v0"
    """A Gymnasium id, or `module:id` for one that a module registers."""
    dynamics: Dynamics = {}
    """Keyword arguments of the environment: the imitator's own dynamics; numbers, texts, truth values, lists and
    mappings, and `max_episode_steps`, its time limit. Environments of ours take numbers."""

    @field_validator("dynamics")
    @classmethod
    def _as_given(cls, dynamics: Dynamics, info: ValidationInfo) -> Dynamics:
        return dynamics_of(info.data["id"], dynamics) if "id" in info.data else dynamics

    def settings(self) -> dict[str, Any]:
        """Return what results depend on, as JSON values: also in what units environments that are not ours are acted
        in, which once were others."""
        return self.model_dump() | ({} if is_ours(self.id) else {"actions": "in units of their bounds"})
