"""How a table was made: the commands that computed a part of it, and what is known of each."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from oodil.pipeline.report import formats


@dataclass(frozen=True)
class Making:
    """The commands that computed parts of a table."""

    shared: str
    """A sentence on what is the same for all of them; empty where nothing is."""
    commands: tuple[tuple[str, str], ...]
    """Each command, and what else is known of it alone."""


def making(made: tuple[dict[str, Any], ...]) -> Making:
    """Return what is known of how a table was made, of entries as `read_made` returns them."""
    known = [dict(_facts(each)) for each in made]
    first = known[0] if known else {}
    shared = {title: said for title, said in first.items() if all(each.get(title) == said for each in known)}
    commands = (
        (
            shlex.join(each.get("command", ())),
            _listed({title: said for title, said in facts.items() if title not in shared}),
        )
        for each, facts in zip(made, known, strict=True)
    )
    return Making(f"Each command: {_listed(shared)}." if shared else "", tuple(commands))


def _facts(made: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield what is known of one command beside itself: titles and texts."""
    for key, value in made.items():
        if key == "machine":
            yield from ((_title(name), _plain(each)) for name, each in value.items())
        elif key == "seconds" and value:
            total, count = sum(value.values()), len(value)
            each = f"{formats.plural(count, 'run')} of {formats.duration(total / count)}"
            yield "took", f"{each} on average, {formats.duration(total)} in all" if count > 1 else each
        elif key not in ("command", "seconds"):
            yield _title(key), _plain(value)


def _listed(facts: dict[str, str]) -> str:
    return "; ".join(f"{title}: {said}" for title, said in facts.items())


def _title(key: str) -> str:
    return re.sub(r" per s$", " per second", key.replace("_", " "))


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{_title(key)} {_plain(each)}" for key, each in value.items())
    if isinstance(value, list):
        return ", ".join(map(_plain, value))
    if not isinstance(value, int | float):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
