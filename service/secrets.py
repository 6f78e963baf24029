"""What people are shown: no passwords, and nothing that a terminal would obey instead of showing it."""

from __future__ import annotations

import re

_PASSWORD = re.compile(r"(?<=://)([^:/@\s]*):[^/\s]+(?=@)")
"""To the last @ before the path: a password may have one that nobody escaped."""
_OBEYED = re.compile(r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters (escape sequences begin with one), marks that turn the direction of writing, and halves of surrogate pairs."""


def mask_secrets(text: str) -> str:
    """Hide the passwords of URLs in a text that people will see.

    Parameters
    ----------
    text : str
        Any text.

    Returns
    -------
    str
        The text with ``user:***@`` in place of ``user:password@``.
    """
    return _PASSWORD.sub(r"\1:***", text)


def visible(text: str) -> str:
    """Write what a terminal would obey, and what cannot be encoded, as escapes.

    Names and targets come from files, devices and other people: ``\\x1b[2J`` must not clear the screen, nor a line break make a line.

    Parameters
    ----------
    text : str
        Any text.

    Returns
    -------
    str
        The same on one line, which every terminal, file and database takes.
    """
    return _OBEYED.sub(lambda found: ascii(found[0])[1:-1], text)


def visible_json(text: str) -> str:
    """The same for a JSON document: its own line breaks stay, and it still says the same.

    Parameters
    ----------
    text : str
        The document, in which JSON has escaped the first 32 characters already.

    Returns
    -------
    str
        The document.
    """
    return _OBEYED.sub(lambda found: found[0] if found[0] == "\n" else f"\\u{ord(found[0]):04x}", text)
