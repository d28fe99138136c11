"""Write docs/results.md, its figures and the README's table from the committed results: nothing is typed by hand.

Every experiment is a folder of benchmarks/results/experiments/ with the results.json and made.json that `oodil table`
wrote; a notes.md beside them says why something is as it is. Further sections are from what benchmarks wrote.

Run ``python docs/make_results.py``.
"""

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from measured import EXPERIMENTS, alone, choice, controls, later, later_curves, paths, speed

from oodil.pipeline.report import formats
from oodil.pipeline.report.table import Table, read_table
from oodil.pipeline.report.table.figures import plots
from oodil.pipeline.report.table.grids import findings
from oodil.pipeline.report.table.summary import Entry
from oodil.pipeline.report.table.texts import lines, markdown, mean, over_seeds
from oodil.pipeline.statistics import ENOUGH_SEEDS

ROOT = Path(__file__).parents[1]
PAGE, FIGURES, README = ROOT / "docs" / "results.md", ROOT / "docs" / "results", ROOT / "README.md"
BEGINNING, END = "\n<!-- results: docs/make_results.py writes this part -->\n", "\n<!-- end of results -->\n"
NAIVE = "naive_gail"

HEAD = """# Results

This page is written by `python docs/make_results.py` from the files of
`benchmarks/results/`. Returns are of mean actions of the policy that is kept; in tables made before
29 November 2026, of which "How it was made" has the times, that is the end of a training, and the distance
that chooses among trainings [hardly saw falls](measurements.md#distances-and-returns). Until 17:00 of that day both
trainings of ours went on from an imitator; since, [one begins anew](decisions.md#our-policy-goes-on-from-an-imitator).
Until 20:00 what an imitator did not do any more after it had failed [was not read](measurements.md#failed-episodes).
With five seeds or more there is the interquartile mean (IQM) with its 95 % interval; fewer are listed and have none."""


def tables(folder: Path = EXPERIMENTS) -> dict[str, Table]:
    """Return the tables of all committed experiments by the name of their folders, tables before figures."""
    folders = [path.parent for path in folder.glob("*/results.json")]
    ordered = sorted(folders, key=lambda path: (not path.name.startswith("table"), path.name))
    return {path.name: read_table(path) for path in ordered}


def page(folder: Path = EXPERIMENTS) -> str:
    """Return the whole page in Markdown."""
    held = tables(folder)
    parts = [HEAD, *summary(held)]
    for name, table in held.items():
        pictures = "\n\n".join(f"![{plot.name}: {name}](results/{name}-{plot.name}.svg)" for plot in plots(table))
        notes = folder / name / "notes.md"
        reasons = f"### Why\n\n{notes.read_text(encoding='utf-8').strip()}" if notes.is_file() else ""
        parts.append(markdown(table, level=2, below="\n\n".join(part for part in (pictures, reasons) if part)).strip())
    parts += [alone(), paths(), later(), controls(), choice(), speed()]
    return "\n\n".join(parts) + "\n"


def summary(held: dict[str, Table]) -> Iterator[str]:
    """Yield what the experiments say together: the state of each, and every published figure of ours beside ours."""
    if not held:
        yield "No experiment is committed yet."
        return
    for name, table in held.items():
        said = " ".join(findings(table)) or "Nothing to compare yet."
        done = len(table.records.cells)
        planned = sum(entry.planned for entry in table.entries.values())
        state = "" if done == planned else f" {done} of {formats.plural(planned, 'cell')}."
        yield f"**[{name}](#{anchor(table)})**:{state} {said}"
    better: list[tuple[str, ...]] = []
    worse: list[tuple[str, ...]] = []
    for name, table in held.items():
        for row in table.records.rows:
            entry = table.entries[row, table.ours]
            if entry.found and entry.published is not None:
                shown, difference = table.measure.shown, entry.found.mean - entry.published
                line = (
                    f"{name}, {row}",
                    shown(entry.found.mean),
                    shown(entry.published),
                    f"{'+' if difference >= 0 else '−'}{table.measure.deviation(abs(difference), entry.published)}",
                    ", ".join(shown(value) for value in entry.by_seed.values()),
                )
                (better if table.marked[row, table.ours] == "found" else worse).append(line)
    head = ("experiment, row", "ours", "paper", "difference", "seeds")
    if better:
        yield "## At or above the paper"
        yield lines(head, better)
    if worse:
        yield "## Below the paper"
        yield "Reasons, where they were found, stand with each experiment."
        yield lines(head, worse)


def readme(text: str, folder: Path = EXPERIMENTS) -> str:
    """Return the README with the committed results in it, or as it is while there are none.

    It has the rows in which ours has enough seeds; naive GAIL's figure is beside it where it has as many.
    """
    rows = []
    for table in tables(folder).values():
        if not {table.ours, NAIVE} <= set(table.records.methods):
            continue
        where = f"[{table.records.caption.partition(',')[0]}](docs/results.md#{anchor(table)})"
        for row in table.records.rows:
            ours, naive = (table.entries[row, method] for method in (table.ours, NAIVE))
            if len(ours.by_seed) < ENOUGH_SEEDS:
                continue
            compared = (ours, naive) if len(naive.by_seed) >= ENOUGH_SEEDS else (ours,)
            best = table.measure.best(*(entry.found.mean for entry in compared if entry.found))
            told_of = [cell(table, entry, best) for entry in compared] + [formats.UNKNOWN] * (2 - len(compared))
            shares = [table.by_seed(row, table.ours, figure).values() for figure in ("share_before", "share_after")]
            told = " -> ".join(formats.percent(sum(share) / len(share)) for share in shares if share) or formats.UNKNOWN
            rows.append((f"{where}, {row}", ranges(sorted(ours.by_seed)), *told_of, told))
    if not rows:
        return text
    head = ("environment and row", "seeds", "ours", "naive GAIL", "share before -> after")
    above, _, rest = text.partition(BEGINNING)
    return f"{above}{BEGINNING}\n{lines(head, rows, escape=False)}\n{END}{rest.partition(END)[2]}"


def cell(table: Table, entry: Entry, best: float) -> str:
    """Return the mean of an entry, in bold if it is the best, and its seeds."""
    shown = mean(table, entry)
    bold = f"**{shown}**" if entry.found and entry.found.mean == best else shown
    return f"{bold} ({over_seeds(table, entry)})"


def ranges(seeds: Sequence[int]) -> str:
    """Return ascending numbers, those that follow one another by the first and the last."""
    parts: list[list[int]] = []
    for seed in seeds:
        if parts and seed == parts[-1][-1] + 1:
            parts[-1].append(seed)
        else:
            parts.append([seed])
    return ", ".join(str(part[0]) if len(part) == 1 else f"{part[0]} to {part[-1]}" for part in parts)


def anchor(table: Table) -> str:
    """Return where an experiment stands on the page."""
    return table.records.experiment.lower().replace(".", "")


def figures(folder: Path = EXPERIMENTS) -> dict[str, str]:
    """Return all figures in SVG by the names of their files."""
    drawn = {
        f"{name}-{plot.name}.svg": plot.sheet(table) for name, table in tables(folder).items() for plot in plots(table)
    }
    return drawn | {"later-curves.svg": later_curves()}


def main() -> None:
    """Write page, README and figures; figures that the page no longer has are removed."""
    PAGE.write_text(page(), encoding="utf-8")
    README.write_text(readme(README.read_text(encoding="utf-8")), encoding="utf-8")
    shutil.rmtree(FIGURES, ignore_errors=True)
    drawn = figures()
    if drawn:
        FIGURES.mkdir()
    for name, svg in drawn.items():
        (FIGURES / name).write_text(svg + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
