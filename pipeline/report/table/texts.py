"""The table as text: Markdown, CSV and LaTeX."""

import csv
import io
import re
from collections.abc import Sequence

from oodil.pipeline.report import formats
from oodil.pipeline.report.table.grids import Grid, findings, grids, notes
from oodil.pipeline.report.table.making import making
from oodil.pipeline.report.table.summary import MEASURES, Entry, Table

COLUMNS = ("mean_return", "std_return", *(name for name in MEASURES if name != "mean_return"))
"""Figures of a cell in the CSV file."""


def mean(table: Table, entry: Entry) -> str:
    """Return the mean of an entry; a dash where no seed has a figure."""
    return table.measure.shown(entry.found.mean) if entry.found else formats.UNKNOWN


def deviation(table: Table, entry: Entry) -> str:
    """Return the deviation of an entry, with its sign; nothing for one seed or none."""
    if entry.found is None or len(entry.by_seed) < 2:
        return ""
    return f"± {table.measure.deviation(entry.found.deviation, entry.found.mean)}"


def over_seeds(table: Table, entry: Entry) -> str:
    """Return the interquartile mean and its interval, or with few seeds the values themselves."""
    if entry.found is None:
        return formats.UNKNOWN
    shown = table.measure.shown
    if entry.found.interval:
        low, high = entry.found.interval
        said = f"IQM {shown(entry.found.interquartile_mean)} ({shown(low)} to {shown(high)})"
    else:
        said = " · ".join(map(shown, entry.by_seed.values()))
    fewer = len(entry.by_seed) < entry.planned
    return f"{said}, {len(entry.by_seed)} of {entry.planned} seeds" if fewer else said


def explained(table: Table) -> str:
    """Return how the table is to be read."""
    records = table.records
    known = sorted({seed for entry in table.entries.values() for seed in entry.by_seed})
    seeds = ", ".join(map(str, known or records.seeds))
    said = f"{table.measure.title.capitalize() if table.measure.title != 'AUROC' else 'AUROC'}: mean ± standard "
    said += f"deviation over seed{'s' * (len(known or records.seeds) > 1)} {seeds}. "
    if table.marks_rows:
        return said + "Marked: the best of each row."
    if not records.published:
        return said.rstrip()
    source = f" ({records.source})" if records.source else ""
    return said + f"In parentheses: the published figure{source}. Marked: the better of the two."


def markdown(table: Table, level: int = 1, below: str = "") -> str:
    """Return the whole of the table's page that is not a figure.

    Args:
        level: Of the heading that is its title.
        below: What stands below the table itself, such as figures.
    """
    records, heading = table.records, "#" * level
    parts = [f"{heading} {_escaped(records.experiment)}", _escaped(records.caption), main_table(table)]
    parts.append(_escaped(explained(table)))
    parts.append("\n".join(f"* {_escaped(line)}" for line in (*findings(table), *notes(table))))
    parts.append(below)
    parts.append(f"{heading}# Over seeds")
    head = ("", *records.methods.values())
    parts.append(lines(head, [(row, *(over_seeds(table, e) for e in _entries(table, row))) for row in records.rows]))
    for grid in grids(table):
        parts += [f"{heading}# {grid.title}", _escaped(grid.caption), grid_table(grid)]
    made = making(records.made)
    if made.commands:
        parts += [f"{heading}# How it was made", _escaped(made.shared)]
        parts.append(
            "\n".join(
                f"* {f'`{command}` ' * bool(command)}{_escaped(facts)}".rstrip() for command, facts in made.commands
            )
        )
    return "\n\n".join(part for part in parts if part) + "\n"


def main_table(table: Table) -> str:
    """Return the table itself in Markdown, the marked figures in bold."""
    records = table.records
    rows = []
    for row in records.rows:
        cells = []
        for entry in _entries(table, row):
            mark = table.marked.get((row, entry.method))
            cell = [_bold(mean(table, entry), mark == "found"), deviation(table, entry)]
            if entry.published is not None:
                cell.append(f"({_bold(table.measure.shown(entry.published), mark == 'published')})")
            cells.append(" ".join(part for part in cell if part))
        rows.append((_escaped(row), *cells))
    head = tuple(map(_escaped, ("", *records.methods.values())))
    return lines(head, rows, escape=False)


def grid_table(grid: Grid) -> str:
    """Return a grid in Markdown."""
    return lines(grid.head, grid.rows)


def _entries(table: Table, row: str) -> list[Entry]:
    return [table.entries[row, method] for method in table.records.methods]


def lines(head: tuple[str, ...], rows: Sequence[tuple[str, ...]], escape: bool = True) -> str:
    """Return a table of text in Markdown."""
    written = [tuple(map(_escaped, row)) if escape else row for row in (head, *rows)]
    first, *rest = (f"| {' | '.join(row)} |".replace(formats.SPACE, " ") for row in written)
    return "\n".join([first, "|---" * len(head) + "|", *rest])


def _bold(text: str, marked: bool) -> str:
    return f"**{text}**" if marked else text


def _escaped(text: str) -> str:
    return re.sub(r"([\\`*_<>|\[\]])", r"\\\1", " ".join(text.split()))


def comma_separated(table: Table) -> str:
    """Return one line per cell in CSV, with all its figures in full."""
    written = io.StringIO()
    writer = csv.writer(written, lineterminator="\n")
    writer.writerow(["experiment", "row", "method", "title", "seed", *COLUMNS, "published"])
    records = table.records
    order = {place: i for i, place in enumerate(table.entries)}
    for cell in sorted(records.cells, key=lambda cell: (order[cell.row, cell.method], cell.seed)):
        published = records.published.get(cell.row, {}).get(cell.method)
        figures = [getattr(cell, name) for name in COLUMNS]
        place = [records.experiment, cell.row, cell.method, records.methods[cell.method], cell.seed]
        writer.writerow([*place, *figures, published])
    return written.getvalue()


def latex(table: Table) -> str:
    """Return the table in LaTeX, for the packages booktabs and, if it is wide, graphicx."""
    records = table.records
    written = [
        r"% Needs \usepackage{booktabs}.",
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{_tex(' '.join((records.caption, explained(table).replace('Marked', 'Bold'))).strip())}}}",
        rf"\label{{tab:{re.sub(r'[^A-Za-z0-9-]+', '-', records.experiment)}}}",
        rf"\begin{{tabular}}{{l{'r' * len(records.methods)}}}",
        r"\toprule",
        " & ".join(("", *map(_tex, records.methods.values()))) + r" \\",
        r"\midrule",
    ]
    for row in records.rows:
        cells = []
        for entry in _entries(table, row):
            mark = table.marked.get((row, entry.method))
            cell = [_tex_bold(mean(table, entry), mark == "found"), _tex(deviation(table, entry))]
            if entry.published is not None:
                cell.append(f"({_tex_bold(table.measure.shown(entry.published), mark == 'published')})")
            cells.append(" ".join(part for part in cell if part))
        written.append(" & ".join((_tex(row), *cells)) + r" \\")
    return "\n".join([*written, r"\bottomrule", r"\end{tabular}", r"\end{table}", ""])


def _tex_bold(text: str, marked: bool) -> str:
    return rf"\textbf{{{_tex(text)}}}" if marked else _tex(text)


SYMBOLS = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "λ": r"$\lambda$",
    "→": r"$\to$", "–": "--", formats.SPACE: "~", "“": "``", "”": "''", "<": r"$<$", ">": r"$>$",
} | {sign: f"\\{sign}" for sign in "&%$#_{}"}  # fmt: skip


def _tex(text: str) -> str:
    return "".join(SYMBOLS.get(character, character) for character in text)
