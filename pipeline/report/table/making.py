"""How a table was made: the commands that computed a part of it, and what is known of each."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from oodil.pipeline.report import formats


@dataclass(frozen=True)
class Making:
    """The commands that computed parts of a table."""

    shared: str
    """What is the same for all of them; empty where nothing is."""
    commands: tuple[tuple[str, str], ...]
    """Each command, and what else is known of it alone."""


def making(made: tuple[dict[str, Any], ...]) -> Making:
    """Return what is known of how a table was made."""
    known = [dict(_facts(each)) for each in made]
    first = known[0] if known else {}
    shared = {title: said for title, said in first.items() if all(each.get(title) == said for each in known)}
    commands = [
        (shlex.join(map(str, each.get("command", ()))), _listed({k: v for k, v in facts.items() if k not in shared}))
        for each, facts in zip(made, known, strict=True)
    ]
    return Making(_listed(shared), tuple(commands))


def _facts(made: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield what is known of one command beside itself: titles and texts."""
    for key, value in made.items():
        if key == "machine":
            yield from ((_title(name), _plain(each)) for name, each in value.items())
        elif key == "seconds" and value:
            total, each = sum(value.values()), formats.duration(np.mean(list(value.values())))
            longer = f"{formats.plural(len(value), 'run')} of {each} on average, {formats.duration(total)} in all"
            yield "took", longer if len(value) > 1 else f"1 run, {each}"
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
    if not _is_number(value):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
