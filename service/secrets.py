"""Make text safe to show: no passwords, and no characters that control a terminal."""

from __future__ import annotations

import re

_PASSWORD = re.compile(r"(?<=://)([^:/@\s]*):[^/\s]+(?=@)")
"""User and password in a URL, up to the last @ before the path: a password may contain an @ that is not escaped."""
_OBEYED = re.compile(r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters (escape sequences begin with one), marks that change the writing direction, and lone surrogates."""


def mask_secrets(text: str) -> str:
    """Replace ``user:password@`` in the URLs of a text with ``user:***@``."""
    return _PASSWORD.sub(r"\1:***", text)


def visible(text: str) -> str:
    """Return a text on one line, with control characters and unencodable ones as escapes: any terminal, file and database accepts it.

    Names and targets come from files, devices and other people: ``\\x1b[2J`` must not clear the screen, nor a line break start a line.
    """
    return _OBEYED.sub(lambda found: ascii(found[0])[1:-1], text)


def visible_json(text: str) -> str:
    """Escape the characters of `visible` in a JSON document as ``\\uXXXX``, except line breaks: the document keeps its value."""
    return _OBEYED.sub(lambda found: found[0] if found[0] == "\n" else f"\\u{ord(found[0]):04x}", text)
