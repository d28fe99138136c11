"""Take what tables have found into the committed results, from which make_results.py writes the pages.

Cells of a table replace those of the same row, method and seed; all others stay, so that seeds and rows may come from
several machines, one after another. Run ``python docs/keep_table.py tables/NAME ...``.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from measured import EXPERIMENTS

from oodil.pipeline.artifacts import MADE, RESULTS, encode_json
from oodil.pipeline.report.table import read_table


def joined(kept: dict[str, Any], found: dict[str, Any]) -> dict[str, Any]:
    """Return the records of a table with the cells of earlier ones that it does not have itself.

    What belongs to no row or method of the table any more is left out. What the table lacks counts only in rows of
    which it has something: ``--seeds`` is for all rows, those that ``--rows`` leaves out among them.
    """
    rows, methods = list(found["rows"]), list(found["methods"])
    cells = {_place(cell): cell for cell in (*kept["cells"], *found["cells"])}
    failed = {_place(each): each for each in (*kept["failed"], *found["failed"])}
    begun = {each["row"] for each in (*found["cells"], *found["failed"])}
    lacking = [place for place in found["missing"] if place[0] in begun]
    missing = {(row, method, seed) for row, method, seed in (*kept["missing"], *lacking)}

    def order(place: tuple[str, str, int]) -> tuple[int, int, int]:
        row, method, seed = place
        return rows.index(row), methods.index(method), seed

    def known(places: set[tuple[str, str, int]]) -> list[tuple[str, str, int]]:
        return sorted((place for place in places if place[0] in rows and place[1] in methods), key=order)

    return found | {
        "seeds": sorted({*kept["seeds"], *found["seeds"]}),
        "cells": [cells[place] for place in known(set(cells))],
        "failed": [failed[place] for place in known(set(failed) - set(cells))],
        "missing": [list(place) for place in known(missing - set(cells) - set(failed))],
    }


def keep(table: Path, experiments: Path = EXPERIMENTS) -> None:
    """Join the records of a table's folder with those of the same name that are kept.

    Raises DataError, and keeps nothing, for records that are not as described.
    """
    read_table(table)
    found, made = (json.loads((table / name).read_bytes()) for name in (RESULTS, MADE))
    folder = experiments / found["experiment"]
    if folder.exists():
        kept, earlier = (json.loads((folder / name).read_bytes()) for name in (RESULTS, MADE))
        found, made = joined(kept, found), earlier + [each for each in made if each not in earlier]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RESULTS).write_bytes(encode_json(found, sort_keys=False))
    (folder / MADE).write_bytes(encode_json(made))


def _place(cell: dict[str, Any]) -> tuple[str, str, int]:
    return cell["row"], cell["method"], cell["seed"]


def main() -> None:
    """Keep the tables of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="+", type=Path, metavar="TABLE", help="folder of a table, made by oodil table")
    for table in parser.parse_args().tables:
        keep(table)


if __name__ == "__main__":
    main()
