"""What a terminal that knows ASCII alone is given instead."""

import codecs
import os
import sys

_PLAIN = {"✓": "ok", "▶": ">", "✗": "x", "━": "#", "─": "-", "…": "~", "±": "+-", "◀": "<", "–": "-"}


def fit_encoding() -> None:
    """Write ASCII where there is no more: a "C" locale, TERM=dumb or another encoding than UTF; nothing fails by it."""
    codecs.register_error("oodil", _replaced)
    for stream in (sys.stdout, sys.stderr):
        if not stream.encoding.lower().startswith("utf"):
            stream.reconfigure(errors="oodil")  # type: ignore[union-attr]
        elif _knows_ascii_alone():
            stream.reconfigure(encoding="ascii", errors="oodil")  # type: ignore[union-attr]


def _knows_ascii_alone() -> bool:
    # Python itself sets LC_CTYPE to one of these where the locale is "C" (PEP 538).
    coerced = ("C.UTF-8", "C.utf8", "UTF-8")
    chosen = os.environ.get("LC_ALL") or os.environ.get("LC_CTYPE", "")
    if not chosen or (chosen in coerced and "LANG" in os.environ):
        chosen = os.environ.get("LANG", "")
    return chosen in ("C", "POSIX") or os.environ.get("TERM") == "dumb"


def _replaced(error: UnicodeError) -> tuple[str, int]:
    """Return what is written for what cannot be encoded: a sign like it, or its number."""
    assert isinstance(error, UnicodeEncodeError)
    cut = error.object[error.start : error.end]
    return "".join(_PLAIN.get(each, each.encode("ascii", "backslashreplace").decode()) for each in cut), error.end
