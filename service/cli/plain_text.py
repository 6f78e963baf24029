"""Replace characters that a terminal or pipe cannot encode: an answer must not fail because of its µ."""

from __future__ import annotations

import codecs
import io
import sys

NAME = "abbe-plain"
PLAIN = {
    "µ": "u",
    "μ": "u",
    "±": "+-",
    "×": "x",
    "·": "*",
    "°": "deg",
    "²": "^2",
    "³": "^3",
    "−": "-",
    "–": "-",
    "—": "-",
    "…": "...",
    "→": "->",
    "←": "<-",
    "↔": "<->",
    "≤": "<=",
    "≥": ">=",
    "≈": "~",
    "≠": "!=",
    "√": "sqrt",
    "∞": "inf",
    "σ": "sigma",
    "Δ": "delta",
    "’": "'",
    "‘": "'",
    "“": '"',
    "”": '"',
    "✔": "ok",
    "✖": "x",
}


def degrade() -> None:
    """Make stdout and stderr replace characters missing in their encoding: by plain letters, or ``?`` where there are none."""
    codecs.register_error(NAME, _plain)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=NAME)


def _plain(error: UnicodeError) -> tuple[str | bytes, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    out = []
    for one in error.object[error.start : error.end]:
        if 0xDC80 <= ord(one) <= 0xDCFF:  # a byte of a file name that is not text: show its escape
            out.append(f"\\x{ord(one) - 0xDC00:02x}")
            continue
        text = PLAIN.get(one, "?")
        try:
            text.encode(error.encoding)
        except UnicodeEncodeError:
            text = "?"
        out.append(text)
    return "".join(out), error.end
