"""From a YAML file and overrides to a configuration; unknown keys are errors that name the nearest valid key."""

import copy
import difflib
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from oodil.pipeline.config import RunConfig
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.stages import stages

SHIPPED = Path(__file__).absolute().parents[1] / "configs"
"""The configurations that come with oodil, beside this package and not found by way of a link to it."""


def shipped_configs() -> dict[str, Path]:
    """Return the configurations that come with oodil by name, such as ``hopper`` or ``quick/driving``."""
    return {str(path.relative_to(SHIPPED).with_suffix("")): path for path in sorted(SHIPPED.rglob("*.yaml"))}


def find_config(source: str | Path) -> Path:
    """Return the file that a path, or else the name of a shipped configuration, stands for. Raises ConfigError."""
    path = Path(source)
    if path.is_file():
        return path
    shipped = shipped_configs()
    name = str(source).removesuffix(".yaml")
    if name in shipped:
        return shipped[name]
    near = difflib.get_close_matches(name, shipped, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(shipped)}"
    raise ConfigError(f"{source}: no such file, and no configuration of this name comes with oodil; {hint}")


def load_config(
    source: str | Path | Mapping[str, Any] | RunConfig, overrides: Sequence[str] | None = None
) -> RunConfig:
    """Return a validated configuration.

    Args:
        source: a YAML file, the name of a shipped configuration, plain values or a configuration. Paths in a file are
            relative to it, those in plain values to the working directory.
        overrides: ``key.sub=value``, the value in YAML; a number reaches into a list, as in
            ``demonstrations.sources.2.count=500``.

    Raises ConfigError with one line per problem.
    """
    if isinstance(source, RunConfig):
        values, origin, base = source.model_dump(mode="json"), "configuration", Path.cwd()
    elif isinstance(source, Mapping):
        values, origin, base = copy.deepcopy(dict(source)), "configuration", Path.cwd()
    else:
        path = find_config(source)
        values, origin, base = _read_yaml(path), str(path), path.resolve().parent
    for override in overrides or ():
        if isinstance(source, RunConfig) and override.partition("=")[0] in ("preset", "clustering.preset"):
            raise ConfigError(f"override {override!r}: a configuration that is made leaves nothing open for a preset")
        apply_override(values, override)
    _name_modules(values, base)
    return _resolve_paths(parse_config(values, origin), base)


def parse_config(values: dict[str, Any], origin: str) -> RunConfig:
    """Validate plain values. Raises ConfigError that names ``origin``, the key, the value and the nearest valid key.

    Modules of its own can be imported from then on.
    """
    try:
        config = RunConfig.model_validate(values)
    except ValidationError as error:
        problems = [_describe(problem) for problem in error.errors()]
        raise ConfigError("\n".join(f"{origin}: {problem}" for problem in problems)) from None
    find_modules(config)
    try:
        for stage in stages(config):
            stage.check(config)
    except ConfigError as error:
        raise ConfigError(f"{origin}: {error}") from None
    return config


def find_modules(config: RunConfig) -> None:
    """Let this process import what the configuration names, from its own folder if it is not installed."""
    if config.runtime.modules is not None:
        find_modules_in(str(config.runtime.modules))


def find_modules_in(folder: str) -> None:
    """Let this process import modules that lie in a folder and are nowhere else."""
    if folder not in sys.path:
        sys.path.append(folder)  # At the end: a file of any name must not stand for what is installed.


def _name_modules(values: dict[str, Any], base: Path) -> None:
    """Make the folder of modules absolute; without one, that of the file if an environment or a baseline needs it."""
    runtime, environment, baselines = (values.get(name) for name in ("runtime", "environment", "baselines"))
    named = [environment.get("id") if isinstance(environment, dict) else None]
    named += baselines if isinstance(baselines, list) else []
    if runtime is not None and not isinstance(runtime, dict):
        return
    given = (runtime or {}).get("modules")
    if isinstance(given, str) or any(isinstance(each, str) and ":" in each for each in named):
        values["runtime"] = (runtime or {}) | {"modules": str(base / (given or "."))}


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        values = yaml.safe_load(path.read_text())
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid YAML: {error}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected a mapping of keys, found {type(values).__name__}")
    return values


def apply_override(values: dict[str, Any], override: str) -> None:
    """Set the field that ``a.b.0=VALUE`` names. Raises ConfigError where there is no such place."""
    key, equals, text = override.partition("=")
    if not equals or not key:
        raise ConfigError(f"override {override!r} is not of the form key=value")
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"override {override!r}: the value is not valid YAML: {error}") from error
    *parents, last = key.split(".")
    place: Any = values
    for parent in parents:
        place = place.setdefault(parent, {}) if isinstance(place, dict) else place[_index(place, parent, override)]
        if not isinstance(place, dict | list):
            raise ConfigError(f"override {override!r}: {parent} is not a section")
    place[last if isinstance(place, dict) else _index(place, last, override)] = value


def _index(entries: list[Any], part: str, override: str) -> int:
    if not part.isdecimal() or int(part) >= len(entries):
        there = f"has 0 to {len(entries) - 1}" if entries else "is empty"
        raise ConfigError(f"override {override!r}: {part} is not an entry of the list, which {there}")
    return int(part)


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
        source.model_copy(update={"expert": base / source.expert_folder}) if source.expert_folder else source
        for source in demonstrations.sources
    )
    return config.model_copy(
        update={"demonstrations": demonstrations.model_copy(update={"file": file, "sources": sources})}
    )
