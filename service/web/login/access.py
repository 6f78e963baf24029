"""What each route needs, declared on the route itself. One without a declaration is shut, and a test fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from enum import Enum
from typing import Any, TypeVar

from starlette.routing import BaseRoute, Match, Mount

from abbe.service.users.roles import Permission

F = TypeVar("F", bound=Callable[..., Any])
MARK = "__abbe_needs__"
MUTATING = frozenset({"POST", "PUT", "PATCH", "DELETE"})


class Open(Enum):
    """What needs no permission: the way in, pictures and style, and the two questions of supervisors."""

    PUBLIC = "public"


Need = Permission | Open
PUBLIC = Open.PUBLIC
ACTIVE_HEADER = "X-Abbe-Active"
REFRESHED = frozenset({"/api/v1/status", "/api/v1/live", "/api/v1/live/samples"})
"""What pages ask again and again by themselves."""
MOUNTS: dict[str, Need] = {"/static": PUBLIC}


def needs(need: Need) -> Callable[[F], F]:
    """Declare what a route needs; stands directly above its function."""

    def declare(endpoint: F) -> F:
        setattr(endpoint, MARK, need)
        return endpoint

    return declare


def need_of(route: BaseRoute) -> Need | None:
    """What a route needs; None: it is not declared."""
    if isinstance(route, Mount):
        return MOUNTS.get(route.path)
    found = getattr(getattr(route, "endpoint", None), MARK, None)
    return found if isinstance(found, Permission | Open) else None


def in_use(path: str, said: str | None) -> bool:
    """Tell whether a request is a use of its session: one that a page makes by itself does not keep the session alive.

    ``said``: the header ``X-Abbe-Active``, "1" if a person has touched the page since its last request, "0" if not. Without it
    everything counts but what pages refresh.
    """
    return said == "1" if said is not None else path not in REFRESHED


def cells(routes: Sequence[BaseRoute]) -> Iterator[tuple[str, str, Need | None]]:
    """Every method of every path, with what it needs: what a test of the rights walks through."""
    for route in routes:
        methods = getattr(route, "methods", None) or {"GET"}
        for method in sorted(methods - {"HEAD"}):
            yield method, str(getattr(route, "path", route)), need_of(route)


def route_of(routes: Sequence[BaseRoute], scope: Any) -> BaseRoute | None:
    """The route that will answer; None: no path, or not by this method (the router says which)."""
    return next((route for route in routes if route.matches(scope)[0] is Match.FULL), None)
