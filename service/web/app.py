"""The web application: one page, its JSON, and two questions for supervisors. Read only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Protocol

from fastapi import FastAPI, Query
from fastapi.responses import HTMLResponse, Response
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.staticfiles import StaticFiles

from service.web import problems
from service.web.headers import SecurityHeaders
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


def create_app(source: Source, *, version: str, hosts: Sequence[str] = ("127.0.0.1", "localhost", "[::1]")) -> FastAPI:
    """Return the application.

    Parameters
    ----------
    source : Source
        Where the answers come from.
    version : str
        Of this program, for the OpenAPI document.
    hosts : sequence of str
        Names under which the page may be asked for: a foreign page must not reach it through a name of its own (DNS rebinding).
    """
    # FastAPI's own /docs loads its scripts from a CDN; plants have none.
    app = FastAPI(title="Abbe", version=version, docs_url=None, redoc_url=None, openapi_url="/api/v1/openapi.json")
    problems.install(app)
    _add_routes(app, source)
    app.mount("/static", StaticFiles(directory=HERE / "static"), name="static")
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=list(hosts))
    app.add_middleware(SecurityHeaders)
    return app


def _add_routes(app: FastAPI, source: Source) -> None:
    env = environment()
    trouble: dict[int | str, dict[str, object]] = {503: {"model": Problem, "description": "The store does not answer"}}

    @app.get("/", response_class=HTMLResponse, include_in_schema=False)
    async def page() -> HTMLResponse:
        return HTMLResponse(render(env, await source.status(), await source.verifications(PAGE_ROWS)))

    @app.get("/icon.svg", include_in_schema=False)
    async def icon() -> Response:
        return Response(ICON, media_type="image/svg+xml")

    @app.get("/api/v1/status", responses=trouble)
    async def status() -> Status:
        """Devices, running check, next due, broker, last results."""
        return await source.status()

    @app.get("/api/v1/verifications", responses=trouble)
    async def verifications(limit: Annotated[int, Query(ge=1, le=1000)] = 100) -> Verifications:
        """Checks of this machine, newest first."""
        return Verifications(verifications=await source.verifications(limit))

    @app.get("/healthz")
    async def healthz() -> Health:
        """Answer if the process works at all."""
        return Health()

    @app.get("/readyz", responses=trouble)
    async def readyz() -> Health:
        """Answer if the store can be read: without it no check can be kept."""
        await source.verifications(1)
        return Health()
