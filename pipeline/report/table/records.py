"""What an experiment leaves behind, read from its folder: ``results.json`` and, if it is there, ``made.json``."""

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from oodil.pipeline.artifacts import RESULTS, read_json, read_made
from oodil.pipeline.errors import DataError

Number = int | float
"""An integer stays one, so that it is written as one."""


class Held(BaseModel):
    """A part of a file; what it has beyond these fields is left out."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Curve(Held):
    """A learning curve; a return is null where it was not finite."""

    env_steps: tuple[int, ...] = ()
    mean_return: tuple[float | None, ...] = ()

    @model_validator(mode="after")
    def _equally_long(self) -> "Curve":
        if len(self.env_steps) != len(self.mean_return):
            raise ValueError(f"{len(self.env_steps)} env_steps and {len(self.mean_return)} returns")
        return self


class Cell(Held):
    """One method on one row with one seed; null is what the run does not know."""

    row: str
    method: str
    seed: int
    mean_return: Number | None = None
    std_return: Number | None = None
    share_reached: Number | None = None
    auroc: Number | None = None
    share_before: Number | None = None
    share_after: Number | None = None
    effective_number: Number | None = None
    distance: Number | None = None
    env_steps: Number | None = None
    clusters_used: Number | None = None
    purity: Number | None = None
    curve: Curve = Curve()
    sources: dict[str, float | None] = {}
    """Mean weight of each source's demonstrations, by label."""
    scores: dict[str, float | None] = {}
    """Mean score of each source's demonstrations, by label."""


class Failure(Held):
    """A run, or one method of it, that failed."""

    row: str
    seed: int
    method: str | None = None
    reason: str


class Records(Held):
    """Everything that the page of a table is made of."""

    experiment: str
    caption: str = ""
    methods: dict[str, str]
    """Titles by name, in the order of the columns."""
    rows: tuple[str, ...]
    seeds: tuple[int, ...]
    figure: str = "mean_return"
    """Which figure of a cell the table shows."""
    published: dict[str, dict[str, float]] = {}
    """By row and method."""
    source: str = ""
    """Where the published figures come from."""
    cells: tuple[Cell, ...] = ()
    failed: tuple[Failure, ...] = ()
    missing: tuple[tuple[str, str, int], ...] = ()
    """Row, method and seed of cells that are not there yet."""
    random_return: dict[str, float | None] = {}
    expert_return: dict[str, float | None] = {}
    made: tuple[dict[str, Any], ...] = ()
    """How it was made: what is known of each command that computed a part of it."""

    @model_validator(mode="after")
    def _one_cell_each(self) -> "Records":
        if not self.rows or not self.methods:
            raise ValueError("a table needs a row and a method")
        places: set[tuple[str, str, int]] = set()
        for cell in self.cells:
            place = cell.row, cell.method, cell.seed
            if cell.row not in self.rows or cell.method not in self.methods or cell.seed not in self.seeds:
                raise ValueError(f"cell {place} is in no row, column or seed of the table")
            if place in places:
                raise ValueError(f"cell {place} is there twice")
            places.add(place)
        for row, method, seed in (*self.missing, *((each.row, each.method, each.seed) for each in self.failed)):
            if row not in self.rows or method not in (None, *self.methods) or seed not in self.seeds:
                raise ValueError(f"what is missing or failed, {(row, method, seed)}, is in no cell of the table")
        return self


def read_records(folder: Path) -> Records:
    """Return the records of an experiment's folder. Raises DataError for a file that is not as described."""
    path = folder / RESULTS
    values = read_json(path, dict)
    try:
        return Records.model_validate(values | {"made": read_made(folder)})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise DataError(f"{path}: {key + ': ' if key else ''}{first['msg'].removeprefix('Value error, ')}") from None
