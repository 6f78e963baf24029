"""Whether somebody whom the web process names may measure, by the table of users as it is now: the core does not take its word for it."""

from __future__ import annotations

from service.storage.store import Store
from service.users.roles import ALLOWED, Permission, Role


def may_measure(store: Store, who: str) -> bool:
    """Tell whether ``user:NAME`` or ``token:NAME/TOKEN`` is a user who may log in and whose role allows to measure.

    Parameters
    ----------
    store : Store
        Holds the users.
    who : str
        As `service.users.people.Principal` names him.
    """
    kind, _, rest = who.partition(":")
    user = store.user(rest.partition("/")[0]) if kind in {"user", "token"} else None
    if user is None or user.disabled_utc is not None:
        return False
    return any(user.role == role and Permission.MEASURE in ALLOWED[role] for role in Role)  # a role that we do not know allows nothing
