"""An experiment: rows x methods x seeds of configurations, as a file says it, and the runs that it takes.

All methods of a row and a seed are one ordinary run; a method with overrides of its own is a run beside it.
"""

import json
import re
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from oodil.pipeline.artifacts import fingerprint
from oodil.pipeline.config import RunConfig
from oodil.pipeline.config.sections import Section
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.loading import find_config, find_file, load_config, read_yaml, shipped_experiments, validated
from oodil.pipeline.stage import Stage
from oodil.pipeline.stages import needed_for, policies_of, stages


def parse_seeds(value: Any) -> Any:
    """Return the seeds that ``20-24`` or ``20`` stands for; a list is left as it is."""
    if isinstance(value, int) and not isinstance(value, bool):
        return (value,)
    if isinstance(value, str) and (found := re.fullmatch(r"(\d+)-(\d+)", value)):
        first, last = map(int, found.groups())
        return tuple(range(first, last + 1))
    return value


def _as_overrides(value: Any) -> Any:
    """Turn a mapping of keys into overrides; a list of them is left as it is."""
    if isinstance(value, dict):
        return tuple(f"{key}={json.dumps(each)}" for key, each in value.items())
    return value


def _as_method(value: Any) -> Any:
    return {"name": value.rpartition(":")[2], "policy": value} if isinstance(value, str) else value


Overrides = Annotated[tuple[str, ...], BeforeValidator(_as_overrides)]
Seeds = Annotated[tuple[Annotated[int, Field(ge=0)], ...], BeforeValidator(parse_seeds), Field(min_length=1)]


class MethodConfig(Section):
    """One column of a table; the name of a policy alone stands for that policy as the row has it."""

    name: str = Field(min_length=1)
    """By which `ExperimentConfig.published`, ``--methods`` and the results name it."""
    policy: str
    """A policy, named as in ``baselines``, or `imitation`."""
    label: str = ""
    """What it is called on the page; default: the policy's title, or its own name if it has overrides."""
    overrides: Overrides = ()
    """What differs from the row: it is then a run of its own."""


Method = Annotated[MethodConfig, BeforeValidator(_as_method)]


class ExperimentConfig(Section):
    """A table or a figure. Overrides are ``KEY=VALUE`` each, or a mapping of keys to values."""

    name: str = Field(pattern=r"^[A-Za-z0-9_.-]+$")
    """Of the experiment and of its folder."""
    caption: str = ""
    """What stands over the table."""
    run: str
    """The base configuration: one that comes with oodil, or a file, relative to this one."""
    overrides: Overrides = ()
    """What all rows change in it."""
    rows: dict[str, Overrides] = Field(min_length=1)
    """By label, what each row changes besides."""
    methods: tuple[Method, ...] = Field(min_length=1)
    """The columns, in order."""
    seeds: Seeds = (0,)
    """``20-22``, one seed, or a list."""
    row_seeds: dict[str, Seeds] = Field(default={})
    """Other seeds for some rows."""
    measure: Literal["mean_return", "share_reached", "auroc", "share_after", "effective_number", "purity", "distance"]
    """Which figure of a cell the table shows."""
    published: dict[str, dict[str, float]] = Field(default={})
    """By row and method, figures that others have published."""
    source: str = ""
    """Where those come from."""

    @model_validator(mode="after")
    def _known(self) -> "ExperimentConfig":
        names = [method.name for method in self.methods]
        if len(set(names)) != len(names):
            raise ValueError(f"two methods have the same name: {', '.join(names)}")
        for where, row in [("row_seeds", row) for row in self.row_seeds] + [
            ("published", row) for row in self.published
        ]:
            if row not in self.rows:
                raise ValueError(f"{where}: no row {row!r}; there are {', '.join(self.rows)}")
        for row, figures in self.published.items():
            for name in figures:
                if name not in names:
                    raise ValueError(f"published: {row}: no method {name!r}; there are {', '.join(names)}")
        return self

    def seeds_of(self, row: str) -> tuple[int, ...]:
        """Return the seeds of a row."""
        return self.row_seeds.get(row, self.seeds)

    def with_seeds(self, text: str) -> "ExperimentConfig":
        """Return the same with the seeds ``A`` to ``B`` of ``A-B`` in every row, or with the first ``N`` of each row.

        Raises ConfigError for anything else, and for more seeds than there are.
        """
        if "-" in text:
            seeds = parse_seeds(text)
            if isinstance(seeds, str) or not seeds:
                raise ConfigError(f"--seeds {text}: expected A-B, such as 20-24, or a number of seeds")
            return self.model_copy(update={"seeds": seeds, "row_seeds": {}})
        fewest = min((self.seeds_of(row) for row in self.rows), key=len)
        if not text.isdecimal() or not 1 <= int(text) <= len(fewest):
            raise ConfigError(
                f"--seeds {text}: expected A-B, such as 20-24, or a number from 1 to {len(fewest)}, the seeds of "
                f"{self.name} that every row has"
            )
        count = int(text)
        few = {row: seeds[:count] for row, seeds in self.row_seeds.items()}
        return self.model_copy(update={"seeds": self.seeds[:count], "row_seeds": few})


def load_experiment(source: str | Path) -> ExperimentConfig:
    """Return the experiment of a file, or of a name that comes with oodil. Raises ConfigError."""
    path = find_file(source, shipped_experiments(), "experiment")
    experiment = validated(ExperimentConfig, read_yaml(path), str(path))
    beside = path.resolve().parent / experiment.run
    run = beside if beside.is_file() else find_config(experiment.run)
    return experiment.model_copy(update={"run": str(run)})


@dataclass(frozen=True)
class PlannedRun:
    """A run of an experiment."""

    name: str
    """Of its folder."""
    row: str
    seed: int
    methods: dict[str, str]
    """The policy of each of its methods, by the method's name."""
    config: RunConfig

    @cached_property
    def parts(self) -> dict[str, str]:
        """Its `parts_of`."""
        return parts_of(self.config)

    def stages(self, methods: Collection[str]) -> list[Stage]:
        """Return the stages that some of its methods need, each after those it reads from."""
        return needed_for(self.config, {policy for method, policy in self.methods.items() if method in methods})


def parts_of(config: RunConfig) -> dict[str, str]:
    """Return what the jobs of each stage of a run compute, by stage: a text that is equal where the artifacts are.

    It is known before anything is computed. Measurements, which are in no fingerprint, are part of it: they are part of
    the artifacts.
    """
    parts: dict[str, str] = {}
    whole: dict[str, str] = {}
    for stage in stages(config):
        inputs = [whole[name] for name in stage.inputs]
        made_of = [stage.name, stage.version, config.seed, config.evaluation.model_dump(), inputs]
        parts[stage.name] = fingerprint([*made_of, stage.job_settings(config)])
        whole[stage.name] = fingerprint([*made_of, stage.settings(config)])
    return parts


def plan(experiment: ExperimentConfig) -> list[PlannedRun]:
    """Return the runs of an experiment, by row, seed and method. Raises ConfigError for one that cannot be."""
    together = [method for method in experiment.methods if not method.overrides]
    groups = ([("", together)] if together else []) + [
        (method.name, [method]) for method in experiment.methods if method.overrides
    ]
    found: dict[str, PlannedRun] = {}
    for row in experiment.rows:
        loaded = {variant: _config(experiment, row, variant, methods) for variant, methods in groups}
        for seed in experiment.seeds_of(row):
            for variant, methods in groups:
                name = f"{loaded[variant].name}-seed{seed}"
                if name in found:
                    raise ConfigError(
                        f"{experiment.name}: rows {found[name].row!r} and {row!r} would both have runs in {name}; "
                        "rename one"
                    )
                policies = {method.name: method.policy.rpartition(":")[2] for method in methods}
                config = loaded[variant].model_copy(update={"seed": seed})
                found[name] = PlannedRun(name, row, seed, policies, config)
    return list(found.values())


def _config(experiment: ExperimentConfig, row: str, variant: str, methods: list[MethodConfig]) -> RunConfig:
    """Return the configuration of the runs of a row, or of one of its methods. Raises ConfigError that names it."""
    others = list(dict.fromkeys(method.policy for method in methods if method.policy != "imitation"))
    own = methods[0].overrides if variant else ()
    name = "-".join(re.sub(r"[^A-Za-z0-9_.]+", "-", part).strip("-") for part in (row, variant) if part)
    given = [f"name={json.dumps(name)}", f"baselines={json.dumps(others)}"]
    try:
        return load_config(experiment.run, [*experiment.overrides, *experiment.rows[row], *own, *given])
    except ConfigError as error:
        where = f"row {row!r}" + (f", method {variant!r}" if variant else "")
        raise ConfigError(f"{experiment.name}: {where}: {error}") from None


def labels(experiment: ExperimentConfig, runs: list[PlannedRun]) -> dict[str, str]:
    """Return what each method is called, by its name, in the order of the columns."""
    titles = {policy.name: policy.title for run in runs for policy in policies_of(run.config)}
    return {
        method.name: method.label
        or (method.name if method.overrides else titles.get(method.policy.rpartition(":")[2], method.name))
        for method in experiment.methods
    }
