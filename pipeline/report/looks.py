"""Colors and markers of the report, the same in every figure and legend.

A source has the same color and marker in every figure: blue if it is marked transferable, orange if it is marked not
transferable. Blue and orange differ in every common form of color blindness.
"""

from collections.abc import Iterable
from dataclasses import dataclass

INK, MUTED, GRID = "#1c2430", "#687181", "#e6e9ee"

TRANSFERABLE = ("#1f5fa8", "#45b0d8", "#12837a", "#8aa9e8", "#123a63")
NOT_TRANSFERABLE = ("#c84a17", "#f2a63b", "#8c3310", "#ec8577", "#b58a12")
UNKNOWN = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#c05200", "#4b5563", "#b3a400")
CLUSTERS = (
    "#2f7d4f",
    "#8458b3",
    "#a8b545",
    "#c25a9d",
    "#4b3b73",
    "#7cc79a",
    "#8c929c",
    "#c9a2e0",
    "#20463a",
    "#7a5c3e",
)
POLICIES = (INK, "#687181", TRANSFERABLE[0], "#8458b3", "#a3461c", "#12736b", "#8c6d1f", "#a03a72")
"""Colors of learning curves, ours first. Curves are named in their colors, so each has a contrast of 4.5 to white."""
TRAINING = ("#12736b", "#8458b3")
"""Colors of a discriminator's accuracy on demonstrations and on the policy's transitions."""
MARKERS = (("o", "●"), ("s", "■"), ("^", "▲"), ("D", "◆"), ("v", "▼"), ("P", "✚"))
"""Markers of Matplotlib and the characters that stand for them in a legend."""


@dataclass(frozen=True)
class Look:
    """How a source is drawn in every figure and legend."""

    color: str
    marker: str
    glyph: str

    @property
    def text(self) -> str:
        """The color of text on this color: white or ink, whichever has the higher contrast."""
        return max(("#ffffff", INK), key=lambda text: contrast(text, self.color))


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colors by WCAG 2, from 1 to 21; small text needs 4.5."""
    low, high = sorted((_luminance(one), _luminance(other)))
    return (high + 0.05) / (low + 0.05)


def _luminance(color: str) -> float:
    channels = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def source_looks(transferable: Iterable[bool | None]) -> list[Look]:
    """Return one look per source; the next marker is used when all colors of a family are taken."""
    transferable = list(transferable)
    families = {True: TRANSFERABLE, False: NOT_TRANSFERABLE, None: UNKNOWN}
    if set(transferable) != {None}:
        families[None] = ("#7c5fa8", "#6b7280", "#b49bd4", "#3f3a5c")
    used = {True: 0, False: 0, None: 0}
    looks = []
    for known in transferable:
        family = families[known]
        marker, glyph = MARKERS[used[known] // len(family) % len(MARKERS)]
        looks.append(Look(family[used[known] % len(family)], marker, glyph))
        used[known] += 1
    return looks
