"""The permission that each route needs, declared on the route. A route without a declaration is closed, and a test fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from enum import Enum
from typing import Any, TypeVar

from starlette.routing import BaseRoute, Match, Mount

from abbe.service.domain.people import Permission

F = TypeVar("F", bound=Callable[..., Any])
MARK = "__abbe_needs__"
MUTATING = frozenset({"POST", "PUT", "PATCH", "DELETE"})


class Open(Enum):
    """Marks routes that need no permission: login, pictures and style sheet, and the two health checks."""

    PUBLIC = "public"


Need = Permission | Open
PUBLIC = Open.PUBLIC
ACTIVE_HEADER = "X-Abbe-Active"
REFRESHED = frozenset({"/strip", "/api/v1/status", "/api/v1/live", "/api/v1/live/samples"})
"""Paths that pages refresh by themselves."""
MOUNTS: dict[str, Need] = {"/static": PUBLIC}


def needs(need: Need) -> Callable[[F], F]:
    """Declare the permission of a route; put this decorator directly above the route's function."""

    def declare(endpoint: F) -> F:
        setattr(endpoint, MARK, need)
        return endpoint

    return declare


def need_of(route: BaseRoute) -> Need | None:
    """Declared permission of a route; None: no declaration."""
    if isinstance(route, Mount):
        return MOUNTS.get(route.path)
    found = getattr(getattr(route, "endpoint", None), MARK, None)
    return found if isinstance(found, Permission | Open) else None


def in_use(path: str, active: str | None) -> bool:
    """Whether a request extends its session; an automatic refresh does not.

    ``active``: the header ``X-Abbe-Active``, "1" if a person has used the page since its last request, "0" if not. Without the header
    every path outside `REFRESHED` counts as use.
    """
    return active == "1" if active is not None else path not in REFRESHED


def route_permissions(routes: Sequence[BaseRoute]) -> Iterator[tuple[str, str, Need | None]]:
    """Method, path and permission of every route, for tests of the rights and for OpenAPI."""
    for route in routes:
        methods = getattr(route, "methods", None) or {"GET"}
        for method in sorted(methods - {"HEAD"}):
            yield method, str(getattr(route, "path", route)), need_of(route)


def route_of(routes: Sequence[BaseRoute], scope: Any) -> BaseRoute | None:
    """The route that will answer; None: unknown path or method (the router distinguishes them)."""
    return next((route for route in routes if route.matches(scope)[0] is Match.FULL), None)
