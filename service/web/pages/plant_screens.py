"""The plant screens: all machines, devices of this machine with their incidents, settings and diagnostics."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime
from typing import Literal
from urllib.parse import urlencode

from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, Response

from abbe.service.clock import utc_text
from abbe.service.compensation.proved_levels import KIND
from abbe.service.domain.measured import CampaignRecord
from abbe.service.domain.people import Permission
from abbe.service.domain.progress import DeviceStatus
from abbe.service.domain.service_records import AuditEvent
from abbe.service.queries.fleet import FleetFigure, MachineStatus, machine_statuses
from abbe.service.secrets import mask_secrets
from abbe.service.sequences.journal import Trouble, troubles
from abbe.service.storage.store import Store
from abbe.service.users.people import PIN_ROLES
from abbe.service.verification.alarm_states import folded, is_open
from abbe.service.web import language
from abbe.service.web.api.sources import Sources
from abbe.service.web.frame import THEMES, current
from abbe.service.web.login.access import needs
from abbe.service.web.login.auth_middleware import Visit
from abbe.service.web.page import measured
from abbe.service.web.pages.context import PageContext, Text
from abbe.service.web.pages.diagnostics import bundle, config_of, diagnosis, megabytes
from abbe.service.web.units import SYSTEMS

SORTS = ("worst", "machine", "due")
COLUMNS = (
    "machine", "state", "last_check_utc", "verdict", "worst_figure", "value", "expanded_uncertainty_k2", "limit",
    "share_of_limit", "next_due_utc", "next_recipe", "open_alarms", "table_in_force",
)  # fmt: skip
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


@dataclass(frozen=True, slots=True)
class FleetLine:
    """One machine: state, worst figure, and number of open alarms."""

    machine: MachineStatus
    worst: FleetFigure | None
    alarms: int

    @property
    def share(self) -> float | None:
        """The worst figure divided by its limit; None if no figure has a limit."""
        one = self.worst
        return None if one is None or not one.limit else one.value / one.limit

    @property
    def share_u(self) -> float | None:
        """Expanded uncertainty of `share` (k = 2); None if U of the figure is unknown."""
        one = self.worst
        return None if one is None or not one.limit or one.expanded is None else one.expanded / one.limit

    @property
    def upper(self) -> float:
        """Sort key: the upper end of the share; infinite without figures, so that unknown machines come first."""
        return float("inf") if self.share is None else self.share + (self.share_u or 0.0)


@dataclass(frozen=True, slots=True)
class FleetQuery:
    """Filter and order: part of a name, a verdict, and the sort key."""

    name: str = ""
    verdict: str = ""
    sort: str = SORTS[0]


def fleet_lines(store: Store, now: datetime, query: FleetQuery) -> list[FleetLine]:
    """The matching machines in the requested order."""
    lines = [_line(store, one) for one in machine_statuses(store, now) if _fits(one, query)]
    if query.sort == "machine":
        return sorted(lines, key=lambda one: one.machine.machine)
    if query.sort == "due":
        return sorted(lines, key=lambda one: (_sortable(one.machine.next_due_utc), one.machine.machine))
    return sorted(lines, key=lambda one: (-one.upper, -one.alarms, one.machine.machine))


def _sortable(utc: str) -> str:
    return utc_text(datetime.fromisoformat(utc)) if utc else "~"  # machines without a due time come last


def _fits(one: MachineStatus, query: FleetQuery) -> bool:
    return query.name.casefold() in one.machine.casefold() and query.verdict in {"", one.verdict}


def _line(store: Store, one: MachineStatus) -> FleetLine:
    judged = [figure for figure in one.figures if figure.limit]
    worst = max(judged, key=lambda f: (f.value + (f.expanded or 0.0)) / (f.limit or 1.0), default=None)
    return FleetLine(one, worst, sum(is_open(alarm) for alarm in folded(store.alarms.entries(one.machine))))


def fleet_csv(lines: Sequence[FleetLine]) -> str:
    """The machines as CSV: figures in the unit at the end of their name, times in UTC."""
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n")
    write.writerow(COLUMNS)
    for line in lines:
        one, worst = line.machine, line.worst
        figure = ("", "", "", "", "") if worst is None else (worst.name, worst.value, worst.expanded, worst.limit, line.share)
        head = (one.machine, one.state, one.check_utc, one.verdict)
        write.writerow([_cell(v) for v in (*head, *figure, one.next_due_utc, one.next_recipe)] + [line.alarms, one.verified.text])
    return out.getvalue()


def _cell(value: object) -> object:
    """A cell that a spreadsheet does not take for a formula."""
    if value is None:
        return ""
    return "'" + value if isinstance(value, str) and value.startswith(_FORMULA) else value


CAMPAIGNS = 10
"""Number of latest campaigns that are searched for incidents."""
INSTRUMENTS = ("ballbar", "laser")
SOON_DAYS = 30
CONTROLLER = "cnc"
PROOFS = 20


@dataclass(frozen=True, slots=True)
class Certificate:
    """The certificate of an instrument. ``until``: last valid day, None: unknown; ``days``: days left, negative: expired."""

    until: date | None
    days: int = 0

    @property
    def sign(self) -> str:
        """``ok``, ``bad`` (expired), or ``open`` (expires within `SOON_DAYS`, or unknown)."""
        if self.until is None:
            return "open"
        return "bad" if self.days < 0 else "open" if self.days < SOON_DAYS else "ok"


@dataclass(frozen=True, slots=True)
class DeviceLine:
    """One device. ``url``: without passwords; ``certificate``: None unless it is an instrument; ``firmware``: empty if unknown."""

    device: DeviceStatus
    url: str
    certificate: Certificate | None
    firmware: str = ""


@dataclass(frozen=True, slots=True)
class DeviceScreen:
    """Devices, and the incidents of their connections in the latest campaigns; ``campaigns``: number of these campaigns."""

    lines: Sequence[DeviceLine]
    incidents: Sequence[Trouble]
    campaigns: int


def device_screen(
    store: Store, machine: str, devices: Sequence[DeviceStatus], until: Mapping[str, date] | None, today: date
) -> DeviceScreen:
    """The devices of a machine, and the incidents of their connections in its latest campaigns."""
    own = {record.id for record in store.machines.all() if record.name == machine}
    campaigns = latest_of(store, own)
    latest, numbers = campaigns[-CAMPAIGNS:], {c.id for c in campaigns}
    journal = [entry for campaign in latest for entry in store.checkpoints.of_campaign(campaign.id)]
    proof = next((one.doc for one in store.solutions.latest(KIND, PROOFS) if one.campaign_id in numbers), {})
    known = proof.get("identity") or {}
    firmware = " ".join(str(known[k]) for k in ("model", "firmware") if known.get(k))
    lines = [
        DeviceLine(d, mask_secrets(d.url), _certificate(d.role, until or {}, today), firmware if d.role == CONTROLLER else "")
        for d in devices
    ]
    return DeviceScreen(lines, list(reversed(troubles(journal))), len(latest))


def latest_of(store: Store, machines: Collection[int]) -> list[CampaignRecord]:
    """Campaigns of the given machine descriptions, oldest first."""
    return [c for c in store.campaigns.all() if c.machine_id in machines]


def _certificate(role: str, until: Mapping[str, date], today: date) -> Certificate | None:
    if role not in INSTRUMENTS:
        return None
    last = until.get(role)
    return Certificate(None) if last is None else Certificate(last, (last - today).days)


Sort = Literal["worst", "machine", "due"]
BUNDLE_ACTION = "support bundle"


def add_plant_screens(app: FastAPI, context: PageContext, sources: Sources) -> None:
    """Add the screens of machines, devices, settings and diagnostics to the application."""
    _add_fleet(app, context, sources)
    _add_devices(app, context, sources)
    _add_settings(app, context, sources)


def _add_fleet(app: FastAPI, context: PageContext, sources: Sources) -> None:
    @app.get("/fleet", include_in_schema=False)
    @needs(Permission.READ)
    async def fleet(name: Text = "", verdict: Text = "", sort: Sort = "worst") -> HTMLResponse:
        query, now, lang = FleetQuery(name, verdict, sort), sources.reader.clock.utc(), current().lang
        lines = await context.read(fleet_lines, sources.reader.store, now, query)

        def named(key: str) -> tuple[str, str]:
            text, unit = language.figure(lang, key)
            return text, current().unit(unit)

        return await context.show(
            "fleet.html",
            lines=lines,
            query=query,
            sorts=SORTS,
            csv=f"/fleet.csv?{urlencode({'name': name, 'verdict': verdict, 'sort': sort})}",
            ago=lambda utc: language.ago(lang, datetime.fromisoformat(utc), now),
            name=named,
            measured=measured,
        )

    @app.get("/fleet.csv", include_in_schema=False)
    @needs(Permission.READ)
    async def as_csv(name: Text = "", verdict: Text = "", sort: Sort = "worst") -> Response:
        lines = await context.read(fleet_lines, sources.reader.store, sources.reader.clock.utc(), FleetQuery(name, verdict, sort))
        headers = {"Content-Disposition": 'attachment; filename="fleet.csv"'}
        return Response(fleet_csv(lines), media_type="text/csv; charset=utf-8", headers=headers)


def _add_devices(app: FastAPI, context: PageContext, sources: Sources) -> None:
    @app.get("/devices", include_in_schema=False)
    @needs(Permission.READ)
    async def devices() -> HTMLResponse:
        status, now = await context.source.status(), sources.reader.clock.utc()
        until = sources.rules.calibrated_until
        screen = await context.read(device_screen, sources.reader.store, sources.reader.machine, status.devices, until, now.date())
        lang = current().lang
        return await context.show("devices.html", screen=screen, ago=lambda at: language.ago(lang, at, now))


def _lines(sources: Sources) -> list[str]:
    return [] if sources.tail is None else sources.tail.lines()


def _add_settings(app: FastAPI, context: PageContext, sources: Sources) -> None:
    @app.get("/settings", include_in_schema=False)
    @needs(Permission.READ)
    async def settings() -> HTMLResponse:
        own = await context.read(sources.reader.store.people.find, current().who) if current().who else None
        by_pin = own is not None and own.role in PIN_ROLES
        return await context.show("settings.html", themes=THEMES, systems=SYSTEMS, names=language.NAMES, own=own, by_pin=by_pin)

    @app.get("/machine", include_in_schema=False)
    @needs(Permission.CONFIGURE)
    async def machine() -> HTMLResponse:
        stated = sources.stated
        return await context.show("machine.html", stated=stated, sections={} if stated is None else stated.sections())

    @app.get("/diagnostics", include_in_schema=False)
    @needs(Permission.CONFIGURE)
    async def diagnostics() -> HTMLResponse:
        found = await context.read(diagnosis, sources, app.version)
        return await context.show("diagnostics.html", found=found, log=_lines(sources), megabytes=megabytes)

    @app.get("/support.zip", include_in_schema=False)
    @needs(Permission.CONFIGURE)
    async def support(request: Request) -> Response:
        visit: Visit = request.state.visit
        status = await context.source.status()
        found = await context.read(diagnosis, sources, app.version)
        log = _lines(sources)
        made = await context.read(bundle, found, config_of(sources, status, status.mqtt.broker), status, log)
        # The bundle takes data out of the plant: without a record in the audit it is not sent.
        event = AuditEvent(
            who=visit.principal.name,
            action=BUNDLE_ACTION,
            target=sources.reader.machine,
            outcome="done",
            doc={"address": visit.address, "bytes": len(made)},
        )
        await context.auth.record(event)
        headers = {"Content-Disposition": 'attachment; filename="abbe-support.zip"', "Cache-Control": "no-store"}
        return Response(made, media_type="application/zip", headers=headers)
