"""Which commands the audit records. A command missing here is recorded, and a test fails until it is listed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

Given = Mapping[str, Any]


def _always(_: Given) -> bool:
    return True


def _moves(given: Given) -> bool:
    """A dry run of `abbe measure`, or one that writes an NC program, changes nothing."""
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
"""Commands that show something or write a requested file."""

RECORDS_ITSELF = frozenset({"serve", "backup", "restore"})
"""Commands that write their own record: ``serve`` when it begins, since it runs for months; ``restore`` into the restored database."""

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
"""Commands that change a database, a machine, or who is trusted, if the function returns True for their arguments."""


def is_recorded(command: str, given: Given) -> bool:
    """Return whether a call of a command is recorded."""
    if command in READS or command in RECORDS_ITSELF:
        return False
    return CHANGES.get(command, _always)(given)
