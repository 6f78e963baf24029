"""The web application: one page, its JSON, two questions for supervisors, and the way in. It shows; what changes something is guarded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Protocol

from fastapi import FastAPI, Query
from fastapi.responses import HTMLResponse, JSONResponse, Response
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from service.users.roles import Permission
from service.web import problems
from service.web.access import PUBLIC, needs
from service.web.door import Door
from service.web.guard import Guard
from service.web.headers import SecurityHeaders
from service.web.login import add_login
from service.web.page import HERE, ICON, environment, render
from service.web.schemas import Health, Problem, Status, Verification, Verifications

PAGE_ROWS = 60


class Source(Protocol):
    """Where the answers come from."""

    async def status(self) -> Status:
        """Return everything the page shows."""
        ...

    async def verifications(self, limit: int) -> list[Verification]:
        """Return the latest checks, newest first."""
        ...


class Application(FastAPI):
    """FastAPI with our headers outside of everything: also the answer to a defect has them."""

    def build_middleware_stack(self) -> ASGIApp:
        """Return what answers."""
        return SecurityHeaders(super().build_middleware_stack())


def create_app(
    source: Source, *, version: str, hosts: Sequence[str] = ("127.0.0.1", "localhost", "[::1]"), door: Door | None = None
) -> FastAPI:
    """Return the application.

    Parameters
    ----------
    source : Source
        Where the answers come from.
    version : str
        Of this program, for the OpenAPI document.
    hosts : sequence of str
        Names under which the page may be asked for: a foreign page must not reach it through a name of its own (DNS rebinding).
    door : Door, optional
        Users and audit; without it everybody may look, and nobody may change anything.
    """
    # FastAPI's own /docs loads its scripts from a CDN; plants have none.
    app = Application(title="Abbe", version=version, docs_url=None, redoc_url=None, openapi_url=None)
    problems.install(app)
    _add_routes(app, source)
    if door is not None:
        add_login(app, environment(), door)
    app.mount("/static", StaticFiles(directory=HERE / "static"), name="static")
    app.add_middleware(Guard, routes=app.router.routes, door=door)
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=list(hosts))
    return app


def _add_routes(app: FastAPI, source: Source) -> None:
    env = environment()
    trouble: dict[int | str, dict[str, object]] = {503: {"model": Problem, "description": "The store does not answer"}}

    @app.get("/", response_class=HTMLResponse, include_in_schema=False)
    @needs(Permission.READ)
    async def page() -> HTMLResponse:
        return HTMLResponse(render(env, await source.status(), await source.verifications(PAGE_ROWS)))

    @app.get("/api/v1/openapi.json", include_in_schema=False)
    @needs(Permission.READ)
    async def openapi() -> JSONResponse:
        return JSONResponse(app.openapi())

    @app.get("/icon.svg", include_in_schema=False)
    @needs(PUBLIC)
    async def icon() -> Response:
        return Response(ICON, media_type="image/svg+xml")

    @app.get("/api/v1/status", responses=trouble)
    @needs(Permission.READ)
    async def status() -> Status:
        """Devices, running check, next due, broker, last results."""
        return await source.status()

    @app.get("/api/v1/verifications", responses=trouble)
    @needs(Permission.READ)
    async def verifications(limit: Annotated[int, Query(ge=1, le=1000)] = 100) -> Verifications:
        """Checks of this machine, newest first."""
        return Verifications(verifications=await source.verifications(limit))

    @app.get("/healthz")
    @needs(PUBLIC)
    async def healthz() -> Health:
        """Answer if the process works at all."""
        return Health()

    @app.get("/readyz", responses=trouble)
    @needs(PUBLIC)
    async def readyz() -> Health:
        """Answer if the store can be read: without it no check can be kept."""
        await source.verifications(1)
        return Health()
