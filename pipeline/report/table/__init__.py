"""The page of an experiment: a table over seeds in HTML, Markdown, CSV and LaTeX, made of its records alone."""

from pathlib import Path

from oodil.pipeline.artifacts import write_file
from oodil.pipeline.report.table.page import render
from oodil.pipeline.report.table.records import Records, read_records
from oodil.pipeline.report.table.summary import Table
from oodil.pipeline.report.table.texts import comma_separated, latex, markdown

__all__ = ["Records", "Table", "read_records", "read_table", "write_table"]


def read_table(folder: Path) -> Table:
    """Return the table of an experiment's folder. Raises DataError for a file that is not as described."""
    return Table.of(read_records(folder), folder)


def write_table(folder: Path) -> Path:
    """Write ``table.html``, ``.md``, ``.csv`` and ``.tex`` beside the records in a folder; return the page's path.

    Raises DataError for records that are not as described; nothing is written then.
    """
    table = read_table(folder)
    made = {"html": render(table), "md": markdown(table), "csv": comma_separated(table), "tex": latex(table)}
    for ending, text in made.items():
        write_file(folder / f"table.{ending}", text.encode())
    return folder / "table.html"
