"""Passwords do not leave this program in texts that people see."""

from __future__ import annotations

import re

_PASSWORD = re.compile(r"(?<=://)([^:/@\s]*):[^@/\s]+(?=@)")


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
