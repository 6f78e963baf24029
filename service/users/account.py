"""The operating system account of this process, as records of tables name it."""

from __future__ import annotations

import getpass
import os


def login() -> str:
    """The account that runs this command line."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a service account without a name
        return f"user {os.getuid()}"


def by_whom() -> str:
    """The account that orders a table from this command line, as the journal names it."""
    return f"{login()}, by the command line"
