"""From a YAML file and overrides to a configuration; unknown keys are errors that name the nearest valid key."""

import difflib
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from oodil.pipeline.config import RunConfig
from oodil.pipeline.errors import ConfigError


def load_config(path: Path, overrides: list[str] | None = None) -> RunConfig:
    """Read a YAML file, apply ``key.sub=value`` overrides and validate.

    Paths in the file are taken relative to it. Raises ConfigError with one line per problem.
    """
    try:
        values = yaml.safe_load(path.read_text())
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid YAML: {error}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected a mapping of keys, found {type(values).__name__}")
    for override in overrides or []:
        _override(values, override)
    config = parse_config(values, origin=str(path))
    return _resolve_paths(config, path.resolve().parent)


def parse_config(values: dict[str, Any], origin: str) -> RunConfig:
    """Validate plain values. Raises ConfigError that names ``origin``, the key, the value and the nearest valid key."""
    try:
        return RunConfig.model_validate(values)
    except ValidationError as error:
        problems = [_describe(problem) for problem in error.errors()]
        raise ConfigError("\n".join(f"{origin}: {problem}" for problem in problems)) from None


def _override(values: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    if not equals or not key:
        raise ConfigError(f"override {override!r} is not of the form key=value")
    *parents, last = key.split(".")
    for parent in parents:
        values = values.setdefault(parent, {})
        if not isinstance(values, dict):
            raise ConfigError(f"override {override!r}: {parent} is not a section")
    try:
        values[last] = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"override {override!r}: the value is not valid YAML: {error}") from error


def _describe(problem: Any) -> str:
    location = [part for part in problem["loc"] if part not in ("trpo", "ppo")]
    key = ".".join(str(part) for part in location)
    if problem["type"] == "extra_forbidden":
        known = _fields_at(location[:-1])
        near = difflib.get_close_matches(str(location[-1]), known, n=1, cutoff=0.5)
        hint = f"; did you mean {near[0]!r}?" if near else f"; valid keys: {', '.join(known)}"
        return f"unknown key {key!r}{hint}"
    message = problem["msg"].removeprefix("Value error, ")
    if problem["type"] == "missing":
        return f"{key}: required, but missing"
    return f"{key}: {message}, got {problem['input']!r}" if problem["type"] != "value_error" else f"{key}: {message}"


def _fields_at(location: list[Any]) -> list[str]:
    """Return the keys that are valid at a place of the configuration."""
    models: list[Any] = [RunConfig]
    for part in location:
        if isinstance(part, int):
            continue
        models = [m for model in models if part in model.model_fields for m in _models(model.model_fields[part])]
    return sorted({name for model in models for name in model.model_fields})


def _models(field: Any) -> list[type[BaseModel]]:
    found, pending = [], [field.annotation, *field.metadata]
    while pending:
        annotation = pending.pop()
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            found.append(annotation)
        pending.extend(getattr(annotation, "__args__", ()))
    return found


def _resolve_paths(config: RunConfig, base: Path) -> RunConfig:
    demonstrations = config.demonstrations
    file = base / demonstrations.file if demonstrations.file else None
    sources = tuple(
        s if isinstance(s.expert, str) else s.model_copy(update={"expert": base / s.expert})
        for s in demonstrations.sources
    )
    return config.model_copy(
        update={"demonstrations": demonstrations.model_copy(update={"file": file, "sources": sources})}
    )
