"""Colors of figures in the page's dark mode: every color that they are drawn in is a variable of the style sheet."""

import re

from markupsafe import Markup

from oodil.pipeline.report.canvas import STYLE
from oodil.pipeline.report.looks import GRID, INK, MUTED, POLICIES

PAPER = "#ffffff"
DARK = {
    PAPER: "#14181e",
    INK: "#e8ebf0",
    MUTED: "#9aa4b2",
    GRID: "#2b323c",
    STYLE["axes.edgecolor"]: "#4b5563",
} | dict(
    zip(POLICIES[2:], ("#6ea8ee", "#b892e3", "#e8875a", "#4fc0b3", "#d0ad4f", "#e07fb2"), strict=True)
)  # fmt: skip
"""What a color becomes on dark paper; the first two of the policies are ink and muted."""


def themed(svg: str) -> Markup:
    """Return an SVG element whose colors follow the page's mode."""
    return Markup(re.sub("|".join(DARK), lambda found: paint(found[0]), svg))


def paint(color: str) -> str:
    """Return the style sheet's name of a color, with the color itself where it has none."""
    return f"var(--c{color[1:]}, {color})"


def dark_colors() -> str:
    """Return the declarations of all colors in dark mode."""
    return " ".join(f"--c{light[1:]}: {dark};" for light, dark in DARK.items())
