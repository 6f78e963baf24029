"""The web application: pages, HTTP interface, health checks and login behind the middleware."""

from __future__ import annotations

import ipaddress
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

from fastapi import FastAPI, Query
from fastapi.responses import HTMLResponse, JSONResponse, Response
from starlette.middleware.gzip import GZipMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from abbe.service.clock import SystemClock
from abbe.service.domain.people import Permission
from abbe.service.plant.gather import FactsSource, Gatherer
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import Status, StatusSource
from abbe.service.rendering.phrases import phrase
from abbe.service.storage.store import Store
from abbe.service.web import problems
from abbe.service.web.api.measured import add_measured, add_plant
from abbe.service.web.api.results import add_reports, add_results
from abbe.service.web.api.sources import Sources
from abbe.service.web.api.tables import add_table_orders, add_tables
from abbe.service.web.core_link.core_line import CoreLine
from abbe.service.web.document import SecurityHeaders, complete
from abbe.service.web.error_pages import ErrorPages, add_core_unavailable
from abbe.service.web.frame import FrameMiddleware, current
from abbe.service.web.jobs import add_jobs
from abbe.service.web.live import add_live, told
from abbe.service.web.login.access import PUBLIC, needs
from abbe.service.web.login.auth_middleware import AuthMiddleware
from abbe.service.web.login.authentication import Authenticator
from abbe.service.web.login.login import add_login
from abbe.service.web.metrics import add_metrics
from abbe.service.web.mtconnect import add_mtconnect
from abbe.service.web.page import HERE, ICON, environment, render
from abbe.service.web.pages.administration import add_administration
from abbe.service.web.pages.alarms import add_alarm_pages
from abbe.service.web.pages.check import add_check_page
from abbe.service.web.pages.context import PageContext
from abbe.service.web.pages.new import add_live_page, add_new_page
from abbe.service.web.pages.plant_screens import add_plant_screens
from abbe.service.web.pages.proposals import add_table_screen
from abbe.service.web.pages.rehearsal import Rehearsals
from abbe.service.web.pages.routes import add_pages
from abbe.service.web.pages.users import add_user_pages
from abbe.service.web.schemas import Health, LatestChecks, Problem
from abbe.service.web.strip import strip_of


def add_api(app: FastAPI, sources: Sources) -> None:
    """Add every route of `/api/v1` directly to the application, because the auth middleware reads permissions from its routes."""
    for add in (add_measured, add_results, add_tables, add_plant, add_reports):
        add(app, sources)


PAGE_ROWS = 60


@dataclass(frozen=True)
class Parts:
    """Sources of the routes that need a core: jobs, live events, metrics.

    ``recipes``: those that can be started; ``plans``: dry runs that can be shown; ``campaigns``: recipes that end with a proposal;
    ``control``: identity of the machine's control, empty if unknown; ``pushes_itself``: the service itself pushes approved tables.
    """

    core: CoreLine
    store: Store
    machine: str
    recipes: tuple[str, ...]
    plans: Rehearsals = field(default_factory=Rehearsals)
    campaigns: tuple[str, ...] = ()
    control: str = ""
    pushes_itself: bool = False


def as_in_host_header(host: str) -> str:
    """A name or address as in the header ``Host``: IPv6 in brackets, in its shortest form."""
    try:
        address = ipaddress.ip_address(host.removeprefix("[").removesuffix("]"))
    except ValueError:
        return host
    return f"[{address}]" if address.version == 6 else str(address)


class Application(FastAPI):
    """FastAPI with the security headers outermost, so that every response has them, even the response to an unhandled error."""

    behind_tls = False
    status: Callable[[], Awaitable[Status]] | None = None

    def build_middleware_stack(self) -> ASGIApp:
        """Return the middleware stack, wrapped in the security headers."""
        stack = super().build_middleware_stack()
        shown = ErrorPages(stack, environment(), self.status) if self.status is not None else stack
        return SecurityHeaders(shown, behind_tls=self.behind_tls)

    def openapi(self) -> dict[str, Any]:
        """Return the OpenAPI document, including the responses of the middleware."""
        return complete(super().openapi(), self.routes)


def create_app(
    source: StatusSource,
    *,
    version: str,
    hosts: Sequence[str] = ("127.0.0.1", "localhost", "[::1]"),
    auth: Authenticator | None = None,
    plant: FactsSource | None = None,
    parts: Parts | None = None,
    api: Sources | None = None,
) -> FastAPI:
    """Build the application.

    Parameters
    ----------
    source : StatusSource
        Source of the status.
    version : str
        Version of this program, for the OpenAPI document.
    hosts : sequence of str
        Allowed host names, so that a foreign page cannot reach the service through a name of its own (DNS rebinding).
    auth : Authenticator, optional
        Users and audit; without it every visitor may look and none may change anything.
    plant : FactsSource, optional
        Facts for MTConnect; default: the status.
    parts : Parts, optional
        Sources of jobs, live events and metrics.
    api : Sources, optional
        Sources of the data behind `/api/v1`; without it the routes of stored data and the screens of plant and tables are missing.
    """
    # FastAPI's /docs loads scripts from a CDN, which plants cannot reach.
    app = Application(title="Abbe", version=version, docs_url=None, redoc_url=None, openapi_url=None)
    app.behind_tls = auth is not None and auth.behind_tls
    app.status = source.status
    problems.install(app)
    add_core_unavailable(app, environment())
    _add_routes(app, source)
    add_mtconnect(app, plant or Gatherer(source.status))
    if api is not None:
        add_api(app, api)
    if auth is not None:
        add_login(app, environment(), auth)
        context = _page_context(source, auth, api, parts)
        add_pages(app, context)
        add_alarm_pages(app, context)
        add_user_pages(app, context)
        add_check_page(app, context)
        add_live_page(app, context, parts.core.jobs if parts is not None else tuple)
        add_new_page(app, context, parts.plans if parts is not None else Rehearsals())
        if api is not None:
            add_plant_screens(app, context, api)
            add_administration(app, context, api.stated, None if parts is None else parts.core)
            add_table_screen(app, context)
    if parts is not None:
        add_jobs(app, parts.core, parts.recipes, parts.campaigns)
        add_table_orders(app, parts.core)
        add_live(app, parts.core)
        add_metrics(app, parts.store, parts.core, parts.machine, parts.control)
    # Only these are compressed: what holds a person's token beside texts that others can set would tell it by its length.
    app.mount("/static", GZipMiddleware(StaticFiles(directory=HERE / "static"), minimum_size=1000), name="static")
    app.add_middleware(FrameMiddleware, routes=app.router.routes, behind_tls=app.behind_tls)  # inside AuthMiddleware
    app.add_middleware(AuthMiddleware, routes=app.router.routes, auth=auth)
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=[as_in_host_header(host) for host in hosts])
    return app


def _page_context(source: StatusSource, auth: Authenticator, api: Sources | None, parts: Parts | None) -> PageContext:
    if api is None:
        return PageContext(environment(), auth, source, Reader(auth.store, "", SystemClock()))
    pushes_itself, recipes = (False, ()) if parts is None else (parts.pushes_itself, parts.recipes)
    return PageContext(environment(), auth, source, api.reader, api.rules, pushes_itself, recipes)


def _add_routes(app: FastAPI, source: StatusSource) -> None:
    env = environment()
    unavailable: dict[int | str, dict[str, object]] = {503: {"model": Problem, "description": "The store or the core does not answer"}}

    @app.get("/", response_class=HTMLResponse, include_in_schema=False)
    @needs(Permission.READ)
    async def page() -> HTMLResponse:
        return HTMLResponse(render(env, await source.status(), await source.verifications(PAGE_ROWS)))

    @app.get("/strip", response_class=HTMLResponse, include_in_schema=False)
    @needs(Permission.READ)
    async def strip() -> HTMLResponse:
        return HTMLResponse(env.get_template("strip.html").render(bar=strip_of(await source.status())))

    @app.get("/api/v1/openapi.json", include_in_schema=False)
    @needs(Permission.READ)
    async def openapi() -> JSONResponse:
        return JSONResponse(app.openapi())

    @app.get("/icon.svg", include_in_schema=False)
    @needs(PUBLIC)
    async def icon() -> Response:
        return Response(ICON, media_type="image/svg+xml")

    _add_installable(app)

    @app.get("/api/v1/status", responses=unavailable)
    @needs(Permission.READ)
    async def status() -> Status:
        """Devices, running check, next due, broker, last results."""
        found, lang = await source.status(), current().lang
        return replace(found, job=told(found.job, lang), attention=[phrase(lang, text) for text in found.attention])

    @app.get("/api/v1/verifications", responses=unavailable)
    @needs(Permission.READ)
    async def verifications(limit: Annotated[int, Query(ge=1, le=1000)] = 100) -> LatestChecks:
        """Checks of this machine, newest first."""
        return LatestChecks(verifications=await source.verifications(limit))

    @app.get("/healthz")
    @needs(PUBLIC)
    async def healthz() -> Health:
        """The process runs."""
        return Health()

    @app.get("/readyz", responses=unavailable)
    @needs(PUBLIC)
    async def readyz() -> Health:
        """The store is readable and the core answers."""
        await source.ready()
        return Health()


MANIFEST = {
    "name": "Abbe",
    "short_name": "Abbe",
    "start_url": "/",
    "scope": "/",
    "display": "standalone",
    "background_color": "#eef0f2",
    "theme_color": "#22506e",
    "icons": [{"src": "/icon.svg", "sizes": "any", "type": "image/svg+xml", "purpose": "any maskable"}],
}
"""The manifest with which a browser installs the page as a program on a panel or a phone."""


def _add_installable(app: FastAPI) -> None:
    worker = (HERE / "static" / "sw.js").read_text(encoding="utf-8")

    @app.get("/manifest.webmanifest", include_in_schema=False)
    @needs(PUBLIC)
    async def manifest() -> Response:
        return JSONResponse(MANIFEST, media_type="application/manifest+json")

    @app.get("/sw.js", include_in_schema=False)
    @needs(PUBLIC)
    async def service_worker() -> Response:
        """The service worker; it controls only screens below its own address."""
        return Response(worker, media_type="text/javascript")
