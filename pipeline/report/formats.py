"""How numbers are written on the page. A no-break space stands before a unit."""

import math

from oodil.pipeline.runs import shown_return

UNKNOWN = "–"
SPACE = "\u00a0"


def plural(number: int, noun: str) -> str:
    """Return a number and its noun."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def returned(value: float | None) -> str:
    """Return an episode return; a dash where it is unknown or not finite."""
    return UNKNOWN if value is None or not math.isfinite(value) else shown_return(value)


def spread(std: float, mean: float) -> str:
    """Return a standard deviation of episode returns in digits that suit their mean; a dash where it is not finite."""
    if not math.isfinite(std):
        return UNKNOWN
    return f"{std:,.0f}" if max(abs(mean), 10 * std) >= 100 else f"{std:.2g}"


def decimal(value: float | None, digits: int = 3) -> str:
    """Return a number with fixed digits; a dash where it is unknown or not finite."""
    return UNKNOWN if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def percent(share: float) -> str:
    """Return a share in percent, with one decimal close to 0 and to 100."""
    return (
        f"{100 * share:.1f}{SPACE}%" if 0 < share < 0.0995 or 0.9905 < share < 0.9995 else f"{100 * share:.0f}{SPACE}%"
    )


def duration(seconds: float) -> str:
    """Return a time in its two largest units."""
    if seconds < 59.5:
        return f"{seconds:.0f}{SPACE}s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes_left = divmod(minutes, 60)
    return f"{hours}{SPACE}h {minutes_left:02d}{SPACE}min" if hours else f"{minutes}{SPACE}min {rest:02d}{SPACE}s"


def count(value: float) -> str:
    """Return a number of steps in a few characters, such as 2.5 M."""
    for unit, name in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= 0.9995 * unit:  # in three digits, what is just below is the unit
            return f"{value / unit:.3g}{SPACE}{name}"
    return f"{value:.0f}"
