"""The references that are made from the program itself: every field of a configuration, every command.

A page says ``<!-- configuration -->`` or ``<!-- commands -->`` where its part is to appear. A public name that no page
documents is a warning, which ends `make docs`.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, JsonValue
from pydantic.fields import FieldInfo
from sphinx.application import Sphinx
from sphinx.util import logging
from typer.main import get_command

import oodil

logger = logging.getLogger(__name__)


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect to Sphinx."""
    app.connect("source-read", fill_in)
    app.connect("autodoc-process-signature", shorten)
    app.connect("env-check-consistency", check_public_names)
    return {"parallel_read_safe": True}


def fill_in(app: Sphinx, docname: str, source: list[str]) -> None:
    """Put the generated parts into a page."""
    for name, generate in {"configuration": configuration, "commands": commands}.items():
        mark = f"<!-- {name} -->"
        if mark in source[0]:
            source[0] = source[0].replace(mark, generate())


def check_public_names(app: Sphinx, env: Any) -> None:
    """Warn of public names that are not documented."""
    documented = env.get_domain("py").objects
    for name in oodil.__all__:
        if f"oodil.{name}" not in documented:
            logger.warning("oodil.%s is public and on no page of the reference", name)


def shorten(
    app: Sphinx, what: str, name: str, value: Any, options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, ...]:
    """Show arrays as ``NDArray[float32]``, and a section without its fields, which have a page of their own."""
    if isinstance(value, type) and issubclass(value, BaseModel):
        return "", None
    array = re.compile(r"~?numpy\.ndarray\[~?tuple\[.*?\], ~?numpy\.dtype\[~?(?:numpy\.|typing\.)?(\w+)\]\]")
    return tuple(text and re.sub(r"~[\w.]+\.", "", array.sub(r"NDArray[\1]", text)) for text in (signature, returns))


def configuration() -> str:
    """Return a table of the fields of every section, in Markdown."""
    places: dict[type[BaseModel], list[str]] = {}
    for key, model in sections(oodil.RunConfig, ""):
        places.setdefault(model, []).append(key)
    parts = []
    for model, keys in places.items():
        shared = keys[0] if len(keys) == 1 else keys[0].partition(".")[2]
        title = f"`{shared}`" if shared else "The run"
        places_of = f" In `{'` and `'.join(key.partition('.')[0] for key in keys)}`." if len(keys) > 1 else ""
        parts.append(f"({anchor(model)})=\n## {title}\n\n{prose(model.__doc__)}{places_of}\n")
        parts.append("| field | type | default | meaning |\n|---|---|---|---|")
        parts.extend(field_row(name, field) for name, field in model.model_fields.items())
        parts.append("")
    return "\n".join(parts)


def sections(model: type[BaseModel], key: str) -> Iterator[tuple[str, type[BaseModel]]]:
    """Yield a section and all below it, each with its key."""
    yield key, model
    for name, field in model.model_fields.items():
        below = f"{key}.{name}" if key else name
        for each in models_in(field):
            kind = each.model_fields.get("kind")
            yield from sections(each, f"{below}, kind {kind.default}" if kind else below)


def models_in(field: FieldInfo) -> Iterator[type[BaseModel]]:
    """Yield the sections that a field may hold."""
    pending: list[Any] = [field.annotation]
    while pending:
        annotation = pending.pop(0)
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            yield annotation
        pending.extend(getattr(annotation, "__args__", ()))


def field_row(name: str, field: FieldInfo) -> str:
    """Return the row of a field."""
    models = list(models_in(field))
    many = "list of " if "tuple" in str(field.annotation) else ""
    kind = " or ".join(f"[{many}section](#{anchor(each)})" for each in models)
    kind = kind or described(Annotated[field.annotation, None, *field.metadata])
    default = f"`{shown(field.get_default())}`"
    if field.is_required() or models:
        default = "required" if field.is_required() else "its defaults" if not many else "none"
    cells = (f"`{name}`", kind, default, prose(field.description))
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


WORDS = {bool: "true or false", int: "integer", float: "number", str: "text", Path: "path", NoneType: "null"}


def described(annotation: Any) -> str:
    """Return a type in the words of somebody who writes YAML, with its limits."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        held = {limit: getattr(each, limit, None) for each in arguments[1:] for limit in ("ge", "gt", "le", "lt")}
        signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
        limits = [f"{signs[limit]} {value:g}" for limit, value in held.items() if value is not None]
        return ", ".join([described(arguments[0]), *limits])
    if origin is Literal:
        return " or ".join(f"`{value}`" for value in arguments)
    if origin in (Union, UnionType):
        return " or ".join(map(described, arguments))
    if origin is tuple:
        return f"list of {described(arguments[0])}"
    if annotation is JsonValue:
        return "values"
    if origin is dict:
        return f"mapping of {described(arguments[0])} to {described(arguments[1])}"
    return WORDS[annotation]


def shown(value: Any) -> str:
    """Return a default as YAML has it."""
    return json.dumps(value) if value is None or isinstance(value, bool | tuple | dict) else str(value)


def anchor(model: type[BaseModel]) -> str:
    """Return the target of a section's heading."""
    return f"section-{model.__name__.removesuffix('Config').lower()}"


def prose(text: str | None) -> str:
    """Return a docstring in one line of Markdown, its options as code."""
    return re.sub(r"(?<![`\w-])(--[a-z-]+)", r"`\1`", " ".join((text or "").split()))


def commands() -> str:
    """Return usage, help and parameters of every command, in Markdown."""
    from oodil.cli import app

    return "\n".join(describe("oodil", get_command(app)))


def describe(name: str, command: Any) -> Iterator[str]:
    """Yield the lines of a command and of those below it."""
    below = getattr(command, "commands", None)
    if below is not None:
        for each in below.values():
            yield from describe(f"{name} {each.name}", each)
        return
    parameters = [each for each in command.params if each.name != "help"]
    arguments = [argument(each) for each in parameters if not options(each)]
    yield f"## `{name}`\n\n{prose(command.help)}\n\n```text\n{' '.join([name, *arguments])} [OPTIONS]\n```\n"
    yield "| parameter | default | meaning |\n|---|---|---|"
    for each in parameters:
        label = options(each) or argument(each)
        default = "" if each.default is None or each.default is False else f"`{each.default}`"
        default = "required" if each.required else default
        yield f"| `{label}` | {default} | {prose(each.help)} |"
    yield ""


def options(parameter: Any) -> str:
    """Return the names of an option; empty for an argument."""
    return ", ".join(name for name in [*parameter.opts, *parameter.secondary_opts] if name.startswith("-"))


def argument(parameter: Any) -> str:
    """Return how an argument is shown."""
    name = str(parameter.metavar or parameter.name.upper())
    return name + "..." * (parameter.nargs == -1 and not name.endswith("..."))
