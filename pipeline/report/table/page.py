"""The page of a table: everything that the template shows, as one typed structure, and its HTML."""

from dataclasses import dataclass

from markupsafe import Markup

from oodil.pipeline.report import formats
from oodil.pipeline.report.pages import page
from oodil.pipeline.report.table.figures import method_looks, plots
from oodil.pipeline.report.table.grids import Grid, findings, grids, notes
from oodil.pipeline.report.table.making import Making, making
from oodil.pipeline.report.table.summary import Table
from oodil.pipeline.report.table.texts import deviation, explained, mean, over_seeds

CAPTIONS = {
    "seeds": "Every point is a seed. A stroke is the mean, a bar the interval of the interquartile mean, or one "
    "standard deviation where there are fewer than five seeds. Hollow diamond: the published figure.",
    "sweep": "Every point is a seed; lines join means. Hollow diamonds: published figures.",
    "clusters": "Clusters that are not empty, a point per seed.",
    "curves": "True return of the mean action in the imitator's environment: the mean over seeds, and a band of one "
    "standard deviation over seeds.",
}
TITLES = {"seeds": "Every seed", "sweep": "Over the values", "clusters": "Clusters", "curves": "Learning curves"}


@dataclass(frozen=True)
class Shown:
    """An entry of the table."""

    mean: str
    deviation: str
    published: str
    """Empty where there is none."""
    mark: str
    """Which of the two is marked, ``found`` or ``published``; or neither."""
    detail: str


@dataclass(frozen=True)
class Method:
    """A column of the table and how it is drawn."""

    title: str
    color: str
    glyph: str
    dashed: bool


@dataclass(frozen=True)
class Panels:
    """The panels of one kind of figure."""

    title: str
    caption: str
    legend: bool
    each: tuple[tuple[str, Markup], ...]


@dataclass(frozen=True)
class TablePage:
    """Everything that the page shows."""

    name: str
    caption: str
    explained: str
    cells: str
    findings: tuple[str, ...]
    notes: tuple[str, ...]
    methods: tuple[Method, ...]
    rows: tuple[tuple[str, tuple[Shown, ...]], ...]
    panels: tuple[Panels, ...]
    grids: tuple[Grid, ...]
    made: Making


def context(table: Table) -> TablePage:
    """Return everything that the page shows of a table, with its figures drawn."""
    records, looks = table.records, method_looks(table)
    total = sum(entry.planned for entry in table.entries.values())
    entries = {row: [table.entries[row, method] for method in records.methods] for row in records.rows}
    return TablePage(
        name=records.experiment,
        caption=records.caption,
        explained=explained(table),
        cells=f"{formats.plural(len(records.rows), 'row')}, {formats.plural(len(records.methods), 'method')}, "
        f"{formats.plural(len(records.seeds), 'seed')}: {len(records.cells):,} of {formats.plural(total, 'cell')}.",
        findings=tuple(findings(table)),
        notes=tuple(notes(table)),
        methods=tuple(
            Method(records.methods[name], look.color, look.glyph, look.dashes == "dashed")
            for name, look in looks.items()
        ),
        rows=tuple(
            (
                row,
                tuple(
                    Shown(
                        mean=mean(table, entry),
                        deviation=deviation(table, entry),
                        published="" if entry.published is None else table.measure.shown(entry.published),
                        mark=table.marked.get((row, entry.method), ""),
                        detail=over_seeds(table, entry),
                    )
                    for entry in each
                ),
            )
            for row, each in entries.items()
        ),
        panels=tuple(
            Panels(
                TITLES[plot.name],
                CAPTIONS[plot.name],
                not plot.named and plot.name != "clusters",
                tuple(plot.each()),
            )
            for plot in plots(table)
        ),
        grids=grids(table),
        made=making(records.made),
    )


def render(table: Table) -> str:
    """Return the HTML of the page."""
    return page("table.html.j2", page=context(table), head=table.records.methods.values())
