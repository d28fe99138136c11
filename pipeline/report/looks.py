"""Colors and markers of the report, the same in every figure and legend.

A source has the same color and marker in every figure: blue if it is marked transferable, orange if it is marked not
transferable. Blue and orange differ in every common form of color blindness, and markers differ besides.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass

PAPER, SOFT = "#ffffff", "#f7f8fa"
INK, MUTED, LINES, GRID = "#1c2430", "#5f6877", "#7f8896", "#e6e9ee"

# Of sources, clusters and trainings: at least 3 to white paper and to dark paper, so each serves both.
TRANSFERABLE = ("#236cbd", "#2999c3", "#12837a", "#648de0", "#5c7c9a")
NOT_TRANSFERABLE = ("#c84a17", "#ca7b0e", "#a8553a", "#e76654", "#b28812")
UNKNOWN = ("#0072b2", "#bd8300", "#009e73", "#c971a2", "#1c95db", "#c05200", "#5f6d7e", "#9c9000")
UNMARKED = ("#7c5fa8", "#6b7280", "#a080c8", "#6d649e")
"""Of sources without a mark, beside some that have one."""
CLUSTERS = (
    "#2f7d4f",
    "#8458b3",
    "#8a9538",
    "#c25a9d",
    "#755fad",
    "#449f68",
    "#888e98",
    "#b077d1",
    "#367762",
    "#866544",
)
POLICIES = (INK, MUTED, "#1f5fa8", "#8458b3", "#a3461c", "#12736b", "#8c6d1f", "#a03a72")
"""Colors of learning curves, ours first. Curves are named in their colors, so each has a contrast of 4.5."""
TRAINING = ("#12786f", "#8458b3")
"""Colors of a discriminator's accuracy on demonstrations and on the policy's transitions."""
DARK = {
    PAPER: "#12161c",
    SOFT: "#171c24",
    INK: "#e8ebf0",
    MUTED: "#a4adbb",
    LINES: "#727c8b",
    GRID: "#2a323d",
    "#1f5fa8": "#5b9ae1",
    "#8458b3": "#a889c9",
    "#a3461c": "#e0794a",
    "#12736b": "#1aa89c",
    "#8c6d1f": "#ba9129",
    "#a03a72": "#cf7ba9",
}
"""What stands for a color on dark paper; any other color stays. The page's style sheet and `on_any_paper` use it."""
MARKERS = (("o", "●"), ("s", "■"), ("^", "▲"), ("D", "◆"), ("v", "▼"), ("P", "✚"), ("X", "✖"))
"""Markers of Matplotlib and the characters that stand for them in a legend."""


def on_any_paper(text: str) -> str:
    """Return text of a page or a figure in which colors follow the reader's choice of light or dark."""
    return re.sub("|".join(DARK), lambda found: f"var(--{found[0][1:]},{found[0]})", text)


@dataclass(frozen=True)
class Look:
    """How a source is drawn in every figure and legend."""

    color: str
    marker: str
    glyph: str

    @property
    def text(self) -> str:
        """The color of text on this color: white or black, whichever has the higher contrast."""
        return max(("#ffffff", "#000000"), key=lambda text: contrast(text, self.color))


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colors by WCAG 2, from 1 to 21; small text needs 4.5."""
    low, high = sorted((_luminance(one), _luminance(other)))
    return (high + 0.05) / (low + 0.05)


def _luminance(color: str) -> float:
    channels = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def source_looks(transferable: Iterable[bool | None]) -> list[Look]:
    """Return one look per source: colors of its family in turn, and markers; families begin at different ones."""
    transferable = list(transferable)
    families = {True: TRANSFERABLE, False: NOT_TRANSFERABLE, None: UNKNOWN}
    first_marker = {True: 0, False: 3, None: 0}
    if set(transferable) != {None}:
        families[None], first_marker[None] = UNMARKED, 5
    used = {True: 0, False: 0, None: 0}
    looks = []
    for known in transferable:
        family = families[known]
        marker, glyph = MARKERS[(first_marker[known] + used[known]) % len(MARKERS)]
        looks.append(Look(family[used[known] % len(family)], marker, glyph))
        used[known] += 1
    return looks
