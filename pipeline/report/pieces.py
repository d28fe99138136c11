"""The small parts of the page, and how numbers are written on it."""

from collections.abc import Iterable
from html import escape

from oodil.pipeline.report.collection import Source
from oodil.pipeline.runs import shown_return

TITLES = {
    "demonstrations": "demonstrations",
    "clustering": "clustering",
    "transferability": "transferability",
    "imitation": "imitation",
    "naive_gail": "naive GAIL",
    "oracle": "oracle",
}
"""What the stages are called on the page."""


def section(title: str, content: str) -> str:
    """Return a section of the page under a heading."""
    return f"<section>\n<h2>{title}</h2>\n{content}\n</section>"


def figure(svg: str, description: str) -> str:
    """Return an SVG element as a figure with a description for those who cannot see it."""
    accessible = svg.replace("<svg", f'<svg role="img" aria-label="{description}"', 1)
    return f"<figure>{accessible}</figure>"


def table(head: str, rows: str, kind: str = "plain") -> str:
    """Return a table of the given cells, which scrolls when it is too wide."""
    body = f"<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}</tbody>"
    return f'<div class="scroll"><table class="{kind}">\n{body}\n</table></div>'


def caption(text: str) -> str:
    """Return a paragraph that explains a figure."""
    return f'<p class="caption">{text}</p>'


def missing(text: str) -> str:
    """Return what stands in the place of a figure that cannot be drawn."""
    return f'<p class="missing">{text}</p>'


def legend(sources: Iterable[Source], counts: bool = False) -> str:
    """Return the list of sources with their colors and markers."""
    items = "".join(f"<li>{name(source)}{f' ({source.count})' if counts else ''}</li>" for source in sources)
    return f'<ul class="legend">{items}</ul>\n'


def name(source: Source) -> str:
    """Return a source's label with its color and marker before it."""
    swatch = f'<span class="swatch" style="color:{source.look.color}">{source.look.glyph}</span>'
    return swatch + escape(source.label or "unnamed")


def plural(number: int, noun: str) -> str:
    """Return a number and its noun."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def returned(value: float | None) -> str | None:
    """Return an episode return as it is written everywhere."""
    return None if value is None else shown_return(value)


def number(value: float | None, digits: int) -> str | None:
    """Return a number with fixed digits."""
    return None if value is None else f"{value:.{digits}f}"


def percent(share: float | None) -> str:
    """Return a share in percent, with a decimal near none and all."""
    if share is None:
        return "–"
    return f"{100 * share:.1f} %" if 0 < share < 0.0995 or 0.9905 < share < 0.9995 else f"{100 * share:.0f} %"


def duration(seconds: float) -> str:
    """Return a time in its two largest units."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes_left = divmod(minutes, 60)
    return f"{hours} h {minutes_left:02d} min" if hours else f"{minutes} min {rest:02d} s"
