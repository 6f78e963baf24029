"""Whether somebody whom the web process names may do something, by the table of users as it is now: it is not believed."""

from __future__ import annotations

from abbe.service.storage.store import Store
from abbe.service.users.roles import ALLOWED, Permission, Role


def may(store: Store, who: str, need: Permission) -> bool:
    """Tell whether ``user:NAME`` or ``token:NAME/TOKEN`` is a user who may log in and whose role has a right.

    Parameters
    ----------
    store : Store
        Holds the users.
    who : str
        As `abbe.service.users.people.Principal` names the user.
    need : Permission
        The right.
    """
    name = person(who)
    user = store.people.find(name) if name else None
    if user is None or user.disabled_utc is not None:
        return False
    return any(user.role == role and need in ALLOWED[role] for role in Role)  # a role that we do not know allows nothing


def person(who: str) -> str:
    """The user's name in ``user:NAME`` or ``token:NAME/TOKEN``; empty where it is neither."""
    kind, _, rest = who.partition(":")
    return rest.partition("/")[0] if kind in {"user", "token"} else ""


def may_measure(store: Store, who: str) -> bool:
    """The same of measuring."""
    return may(store, who, Permission.MEASURE)
