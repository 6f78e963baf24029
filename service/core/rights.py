"""Rights of the users that the web process names, by the current table of users: the core does not trust the web process."""

from __future__ import annotations

from abbe.service.storage.store import Store
from abbe.service.users.roles import ALLOWED, Permission, Role


def may(store: Store, who: str, need: Permission) -> bool:
    """Return whether ``who`` (``user:NAME`` or ``token:NAME/TOKEN``) is a user who may log in and whose role has the right ``need``."""
    name = person(who)
    user = store.people.find(name) if name else None
    if user is None or user.disabled_utc is not None:
        return False
    return any(user.role == role and need in ALLOWED[role] for role in Role)  # an unknown role allows nothing


def person(who: str) -> str:
    """Return the user's name in ``user:NAME`` or ``token:NAME/TOKEN``; empty for anything else."""
    kind, _, rest = who.partition(":")
    return rest.partition("/")[0] if kind in {"user", "token"} else ""


def may_measure(store: Store, who: str) -> bool:
    """Return whether a user may measure, as `may`."""
    return may(store, who, Permission.MEASURE)
