"""What each route needs, declared on the route itself. One without a declaration is shut, and a test fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from enum import Enum
from typing import Any, TypeVar

from starlette.routing import BaseRoute, Match, Mount

from service.users.roles import Permission

F = TypeVar("F", bound=Callable[..., Any])
MARK = "__abbe_needs__"
MUTATING = frozenset({"POST", "PUT", "PATCH", "DELETE"})


class Open(Enum):
    """What needs no permission: the way in, pictures and style, and the two questions of supervisors."""

    PUBLIC = "public"


Need = Permission | Open
PUBLIC = Open.PUBLIC
MOUNTS: dict[str, Need] = {"/static": PUBLIC}


def needs(need: Need) -> Callable[[F], F]:
    """Declare what a route needs; stands directly above its function."""

    def declare(endpoint: F) -> F:
        setattr(endpoint, MARK, need)
        return endpoint

    return declare


def need_of(route: BaseRoute) -> Need | None:
    """What a route needs; None: nobody has said."""
    if isinstance(route, Mount):
        return MOUNTS.get(route.path)
    found = getattr(getattr(route, "endpoint", None), MARK, None)
    return found if isinstance(found, Permission | Open) else None


def cells(routes: Sequence[BaseRoute]) -> Iterator[tuple[str, str, Need | None]]:
    """Every method of every path, with what it needs: what a test of the rights walks through."""
    for route in routes:
        methods = getattr(route, "methods", None) or {"GET"}
        for method in sorted(methods - {"HEAD"}):
            yield method, str(getattr(route, "path", route)), need_of(route)


def route_of(routes: Sequence[BaseRoute], scope: Any) -> BaseRoute | None:
    """The route that will answer; None: no path, or not by this method (the router says which)."""
    return next((route for route in routes if route.matches(scope)[0] is Match.FULL), None)
