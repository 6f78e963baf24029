"""What each command is to the audit. A command that is not here is recorded, and a test fails until it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

Given = Mapping[str, Any]


def _always(_: Given) -> bool:
    return True


def _moves(given: Given) -> bool:
    """`abbe measure` as a rehearsal or as a writer of NC programs changes nothing."""
    return not (given.get("dry_run") or given.get("nc") or given.get("path") or given.get("picture"))


READS = frozenset(
    {
        "plan",
        "simulate",
        "effects",
        "errors",
        "check-config",
        "runs",
        "show",
        "export",
        "vectors",
        "papers",
        "schema",
        "sim",
        "version",
        "model list",
        "model show",
        "model diff",
        "report",
        "trend",
        "fleet",
        "alarm list",
        "comp formats",
        "comp show",
        "comp diff",
        "user list",
        "user token list",
        "audit show",
        "audit verify",
    }
)
"""They show, or write a file that they were asked for."""

RECORDS_ITSELF = frozenset({"serve", "backup", "restore"})
"""The service runs for months: its record is written when it begins. A restored database has the record of its restoring."""

CHANGES: dict[str, Callable[[Given], bool]] = {
    "demo": lambda given: bool(given.get("keep")),
    "measure": _moves,
    "listen": _always,
    "solve": _always,
    "solve-all": lambda given: bool(given.get("store_solutions")),
    "discover": _always,
    "correct": _always,
    "accept-table": _always,
    "alarm acknowledge": _always,
    "import": _always,
    "model revert": _always,
    "comp commission": _always,
    "comp export": lambda given: given.get("sign") is not None,
    "comp import": _always,
    "comp propose": _always,
    "comp approve": _always,
    "comp reject": _always,
    "comp push": _always,
    "comp rollback": _always,
    "key new": _always,
    "user add": _always,
    "user role": _always,
    "user password": _always,
    "user disable": _always,
    "user enable": _always,
    "user token new": _always,
    "user token revoke": _always,
}
"""They change a database, a machine, or who is trusted, if the function says so of their arguments."""


def is_recorded(command: str, given: Given) -> bool:
    """Whether a call of a command leaves a record."""
    if command in READS or command in RECORDS_ITSELF:
        return False
    return CHANGES.get(command, _always)(given)
