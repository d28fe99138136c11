"""Values as they travel: msgpack with limits, and readers that accept one type each.

Nothing is ever unpickled. Whatever is wrong with what arrived is a MessageError and nothing else.
"""

from collections.abc import Callable
from typing import Any

import msgpack

MAX_HEADER_BYTES = 64 * 1024
MAX_TEXT = 32 * 1024
"""Characters of a string; longer tracebacks lose their middle."""
_MAX_ITEMS, _MAX_DEPTH = 16_384, 16

Readers = dict[str, Callable[[Any], Any]]
"""The fields of something that travels, and what reads the value of each."""


class MessageError(ValueError):
    """Bytes that are not a message of this version, or a message that must not be sent."""


def shortened(text: str) -> str:
    """Return a text that fits into a message: without its middle if it is too long."""
    half = MAX_TEXT // 2 - 16
    return text if len(text) <= MAX_TEXT else f"{text[:half]}\n[...]\n{text[-half:]}"


def count(value: Any) -> int:
    """Read a number of things."""
    if type(value) is not int or value < 0:
        raise MessageError(f"expected a count, found {brief(value)}")
    return value


def number(value: Any) -> float:
    """Read a floating-point number."""
    if type(value) is not float:
        raise MessageError(f"expected a floating-point number, found {brief(value)}")
    return value


def text(value: Any) -> str:
    """Read a text of limited length."""
    if type(value) is not str or len(value) > MAX_TEXT:
        raise MessageError(f"expected a text of at most {MAX_TEXT} characters, found {brief(value)}")
    return value


def flag(value: Any) -> bool:
    """Read a truth value."""
    if type(value) is not bool:
        raise MessageError(f"expected a truth value, found {brief(value)}")
    return value


def key(value: Any) -> tuple[int, ...]:
    """Read a random key."""
    return tuple(count(part) for part in items(value))


def numbers_by_name(value: Any) -> dict[str, float]:
    """Read floating-point numbers by name."""
    if type(value) is not dict:
        raise MessageError(f"expected numbers by name, found {brief(value)}")
    return {text(name): number(figure) for name, figure in value.items()}


def values_by_name(value: Any) -> dict[str, Any]:
    """Read what JSON holds by name."""
    if type(value) is not dict:
        raise MessageError(f"expected values by name, found {brief(value)}")
    return {text(name): _plain(each, _MAX_DEPTH) for name, each in value.items()}


def _plain(value: Any, depth: int) -> Any:
    if not depth:
        raise MessageError(f"values in more than {_MAX_DEPTH} others")
    if type(value) is dict:
        return {text(name): _plain(each, depth - 1) for name, each in value.items()}
    if type(value) is list:
        return [_plain(each, depth - 1) for each in value]
    return value if value is None or type(value) in (bool, int, float) else text(value)


def items(value: Any) -> list[Any]:
    """Read a list of anything."""
    if type(value) is not list:
        raise MessageError(f"expected a list, found {brief(value)}")
    return value


def brief(value: Any) -> str:
    """Return what an unexpected value looks like, for a complaint."""
    return f"{type(value).__name__} {str(value)[:40]!r}"


def read(readers: Readers, values: Any) -> dict[str, Any]:
    """Read exactly the fields that there are readers for."""
    if type(values) is not dict or values.keys() != readers.keys():
        raise MessageError(f"expected the fields {sorted(readers)}, found {brief(values)}")
    return {name: reader(values[name]) for name, reader in readers.items()}


def pack(value: Any) -> bytes:
    """Return a value as msgpack."""
    content: bytes = msgpack.packb(value, unicode_errors="backslashreplace")
    return content


def unpack(content: bytes) -> Any:
    """Return the value of some msgpack within the limits."""
    if len(content) > MAX_HEADER_BYTES:
        raise MessageError(f"header has {len(content)} bytes; at most {MAX_HEADER_BYTES} are allowed")
    try:
        return msgpack.unpackb(
            content,
            strict_map_key=True,
            max_str_len=4 * MAX_TEXT,
            max_bin_len=0,
            max_array_len=_MAX_ITEMS,
            max_map_len=_MAX_ITEMS,
            max_ext_len=0,
        )
    except (ValueError, msgpack.UnpackException) as error:
        raise MessageError(f"not msgpack within the limits: {error}") from error
