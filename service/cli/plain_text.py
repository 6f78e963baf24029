"""What a terminal or a pipe cannot show is written in letters that it can: an answer must not fail for its µ."""

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
    """From now on stdout and stderr write whatever their encoding has, and the rest in plain letters; ``?`` where there are none."""
    codecs.register_error(NAME, _plain)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=NAME)


def _plain(error: UnicodeError) -> tuple[str | bytes, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    out = []
    for one in error.object[error.start : error.end]:
        if 0xDC80 <= ord(one) <= 0xDCFF:  # a byte of a file's name that was no text: so it was escaped, so it is shown
            out.append(f"\\x{ord(one) - 0xDC00:02x}")
            continue
        text = PLAIN.get(one, "?")
        try:
            text.encode(error.encoding)
        except UnicodeEncodeError:
            text = "?"
        out.append(text)
    return "".join(out), error.end
