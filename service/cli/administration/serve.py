"""``abbe serve``: the unattended service. Heavy modules are imported when it runs, not for ``--help``."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import JsonOption, MachineOption, answer, conclude, machine_file
from abbe.service.errors import AbbeError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from abbe.service.capture.live import LiveFeed
    from abbe.service.channel.messages import MachineSummary
    from abbe.service.compensation.approved import PushOrder
    from abbe.service.compensation.rollback import RollbackOrder
    from abbe.service.config import LoadedMachine
    from abbe.service.config_schema import AlarmSection, OpcUa, Web
    from abbe.service.core.orders import CampaignOrder, MeasureCampaign, OrderActions
    from abbe.service.core.setup import ServiceSetup
    from abbe.service.domain.progress import JobOutcome, ProgressSink
    from abbe.service.domain.verification import CheckResult
    from abbe.service.mqtt.broker import Broker
    from abbe.service.scheduler.alarm_manager import Duties
    from abbe.service.scheduler.ports import Check
    from abbe.service.sequences.control import Control
    from abbe.service.sequences.steps import CampaignPlan
    from abbe.service.site import Site
    from abbe.service.storage.store import Store
    from abbe.service.verification.alarm_states import Alarm, Note


LONGEST_NAME = 180
"""Longest name, in characters, of a recipe that a person may start: a message to the page holds 200, and the rate is appended to the
name."""


def serve(
    port: Annotated[int | None, typer.Option(help="Port of the status page, instead of [web] port; 0: any.", min=0, max=65535)] = None,
    once: Annotated[
        bool, typer.Option("--once", help="Run every recipe of the timetable once, now, and end; exit code 1 unless all pass.")
    ] = False,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Run scheduled checks unattended, publish results, show a status page. Ends on Ctrl-C or SIGTERM."""
    from abbe.service.config import load_machine
    from abbe.service.files import file_locks

    file_locks()
    loaded = load_machine(machine_file(machine))

    from abbe.service.logs import configure_logs  # the service: not for a file that is wrong
    from abbe.service.serve import serve as run

    setup = setup_of(loaded, port)
    configure_logs(as_json=as_json)
    code = run(setup, once=once)
    word = {0: "all checks passed", 1: "not all checks passed"}.get(code, "ended by a fault") if once else "ended"
    answer({"machine": setup.machine, "exit_code": code, "text": word}, f"{setup.machine}: {word}", as_json=as_json)
    conclude("abbe trend", machine=machine, as_json=as_json)
    raise typer.Exit(code)


def setup_of(loaded: LoadedMachine, port: int | None = None) -> ServiceSetup:
    """Return the setup of the service; ``port`` replaces the file's.

    Raises
    ------
    AbbeError
        A schedule names an unknown recipe, its paths leave the machine's strokes, or a device that it needs is not configured. Reported
        now, not at the first slot in the night.
    """
    from abbe.service.campaigns.plausibility import check_plausibility, check_unattended
    from abbe.service.capture.live import LiveFeed
    from abbe.service.clock import SystemClock
    from abbe.service.core.push_recovery import recover_at_start
    from abbe.service.core.setup import MachineFileSource, ServiceSetup
    from abbe.service.core.table_watch import look_at_table
    from abbe.service.jobs.check import run_check
    from abbe.service.mqtt.broker import Topics
    from abbe.service.scheduler.ready import Ready, look_at
    from abbe.service.sequences.check import dry_run_campaign, paced
    from abbe.service.sequences.recipes.campaigns import RECIPES, campaign_source
    from abbe.service.sequences.steps import CampaignPlan
    from abbe.service.site import rules_of, site_of

    config = loaded.machine
    check_unattended(config, loaded.path.resolve().parent)
    site, live = site_of(config), LiveFeed()

    def check_on(store: Store) -> Check:
        async def check(recipe: str, progress: ProgressSink, control: Control) -> CheckResult:
            return await run_check(config, store, recipe, progress, control=control, live=live)

        return check

    plan, folder = CampaignPlan("", ()), loaded.path.resolve().parent
    if any(entry.on_alarm == "propose" for entry in config.schedule):
        plan = paced(campaign_source(config.alarm.campaign, folder).plan(site.machine), site.max_feed_mm_min)
        dry_run_campaign(site.machine, plan, site.max_feed_mm_min)
    return ServiceSetup(
        machine=config.name,
        doc=site.doc,
        devices={role: url for role, url in config.devices.model_dump().items() if url is not None},
        schedules=tuple(config.schedule),
        store_url=loaded.database_url,
        broker=_broker(loaded),
        topics=Topics(config.mqtt.topic_prefix, config.name),
        web=_web(loaded, port),
        check=check_on,
        maintenance=tuple(config.maintenance),
        ready=lambda clock: Ready(look_at(site.urls), config.schedule, site.temperature_c, config.staffed, clock),
        opcua=_opcua(loaded),
        recipes=tuple(name for name in sorted(RECIPES) if _fits(name, site)),
        recover=lambda store: lambda: recover_at_start(store, site),
        rules=rules_of(config),
        duties=duties_on(config.alarm, site, plan, live=live),
        table=(lambda store: look_at_table(site, store)) if config.alarm.watch_table else None,
        live=live,
        summary=_summary(site),
        actions=None if site.urls.cnc is None else order_actions_on(config.alarm, site),
        campaigns=_campaigns(config.alarm.campaign, site, folder),
        campaign=None if site.urls.cnc is None else campaign_on(site, folder, live),
        stated=loaded.summary(),
        source=MachineFileSource(loaded, lambda other: setup_of(other, port)),
        warnings=check_plausibility(config, folder, SystemClock().utc().date()).warnings,
    )


def _web(loaded: LoadedMachine, port: int | None) -> Web:
    web = loaded.machine.web
    files = {"certificate": _beside(loaded.path, web.certificate), "key": _beside(loaded.path, web.key)}
    return web.model_copy(update=files if port is None else files | {"port": port})


def _summary(site: Site) -> MachineSummary:
    from abbe.service.channel.messages import MachineSummary
    from abbe.service.domain.machine import MachineObject

    return MachineSummary(MachineObject.read(site.doc), site.max_feed_mm_min)


def _broker(loaded: LoadedMachine) -> Broker | None:
    from dataclasses import replace

    from abbe.service.mqtt.broker import TlsFiles, parse

    mqtt = loaded.machine.mqtt
    if mqtt.url is None:
        return None
    files = TlsFiles(*(_beside(loaded.path, name) for name in (mqtt.ca, mqtt.certificate, mqtt.key)))
    broker = replace(parse(mqtt.url), files=files)
    broker.tls_context()  # fail now rather than at every attempt to connect
    return broker


def _opcua(loaded: LoadedMachine) -> OpcUa | None:
    given = loaded.machine.opcua
    if not given.enabled:
        return None

    from abbe.service.plant.opcua.setup import check_opcua  # cryptography

    clients = tuple(_beside(loaded.path, name) for name in given.clients)
    files = {"certificate": _beside(loaded.path, given.certificate), "key": _beside(loaded.path, given.key), "clients": clients}
    setup = given.model_copy(update=files)
    check_opcua(setup)
    return setup


def duties_on(
    alarm: AlarmSection, site: Site, plan: CampaignPlan, rate_hz: int = 100, live: LiveFeed | None = None
) -> Callable[[Store], Duties]:
    """Return a function that takes the service's store and returns its reactions to alarms.

    ``plan``: the full campaign; ``rate_hz``: ball-bar rate of verifications; ``live``: gets the samples of the campaign's paths.
    """
    from abbe.service.clock import SystemClock
    from abbe.service.scheduler.alarm_manager import Duties

    def duties(store: Store) -> Duties:
        clock = SystemClock()

        async def look_into(one: Alarm, note: Note, progress: ProgressSink, control: Control) -> None:
            from abbe.service.jobs.investigate import InvestigationContext, investigate  # an idle service solves and searches nothing

            await investigate(InvestigationContext(site, store, plan, clock, progress, control, live), one, note)

        async def push(order: PushOrder) -> JobOutcome:
            return await (await _push_approved())(site, store, order, clock=clock, rate_hz=rate_hz)

        return Duties(alarm.warn_days, alarm.campaign, look_into, push if alarm.push == "approved" else None)

    return duties


async def _push_approved() -> Callable[..., Awaitable[JobOutcome]]:
    """Load `push_approved` in a thread: it imports the solver, half a second in which page and messages must not wait."""

    def loaded() -> Callable[..., Awaitable[JobOutcome]]:
        from abbe.service.compensation.push_approved import push_approved

        return push_approved

    return await asyncio.to_thread(loaded)


def order_actions_on(alarm: AlarmSection, site: Site) -> Callable[[Store], OrderActions]:
    """Return a function that takes the service's store and returns what a person may order for tables: rollback and push.

    A push can be ordered only if the service never pushes by itself.
    """
    from abbe.service.clock import SystemClock
    from abbe.service.compensation.rollback import ordered_rollback
    from abbe.service.core.orders import OrderActions

    def on(store: Store) -> OrderActions:
        async def back(order: RollbackOrder) -> JobOutcome:
            return await ordered_rollback(site, store, order, clock=SystemClock())

        async def push(order: PushOrder) -> JobOutcome:
            return await (await _push_approved())(site, store, order, clock=SystemClock())

        return OrderActions(back, push if alarm.push == "never" else None)

    return on


def campaign_on(site: Site, folder: Path, live: LiveFeed | None = None) -> Callable[[Store], MeasureCampaign]:
    """Return a function that makes, from the service's store, the job of a full campaign that a person starts.

    ``folder``: folder of the recipe files.
    """
    from abbe.service.clock import SystemClock
    from abbe.service.domain.progress import JobOutcome
    from abbe.service.sequences.recipes.campaigns import campaign_source

    def on(store: Store) -> MeasureCampaign:
        async def measure(order: CampaignOrder) -> JobOutcome:
            from abbe.service.jobs.guided_campaign import investigate_guided, named_for, run_guided_campaign
            from abbe.service.jobs.investigate import InvestigationContext

            source = campaign_source(order.recipe, folder)
            plan = source.plan(site.machine)
            context = InvestigationContext(site, store, plan, SystemClock(), order.progress, order.control, live)
            if order.cause is None:
                return await run_guided_campaign(
                    named_for(context, order.recipe, order.resume), source, order.by, resumes=bool(order.resume)
                )
            await investigate_guided(context, source, *order.cause, resume=order.resume)
            return JobOutcome("done", "")

        return measure

    return on


def _campaigns(named: str, site: Site, folder: Path) -> tuple[str, ...]:
    """Return those full campaigns that fit this machine: the built-in one, and ``named``, which the machine file names for alarms."""
    from abbe.service.sequences.check import dry_run_campaign, paced
    from abbe.service.sequences.recipes.campaigns import IDENTIFICATION, campaign_source

    def fits(name: str) -> bool:
        try:
            plan = paced(campaign_source(name, folder).plan(site.machine), site.max_feed_mm_min)
            dry_run_campaign(site.machine, plan, site.max_feed_mm_min)
        except AbbeError:
            return False
        return len(name) <= LONGEST_NAME

    return tuple(filter(fits, dict.fromkeys((IDENTIFICATION, named))))


def _beside(machine_file: Path, name: str) -> str:
    """Return the absolute path of a file that is named relative to the machine file's folder; an empty name stays empty."""
    return str(machine_file.resolve().parent / name) if name else ""


def _fits(recipe: str, site: Site) -> bool:
    """Return whether a recipe's paths lie inside the machine's strokes."""
    from abbe.service.sequences.check import dry_run_campaign
    from abbe.service.sequences.recipes.campaigns import recipe_plan

    try:
        dry_run_campaign(site.machine, recipe_plan(recipe, site.machine), site.max_feed_mm_min)
    except AbbeError:
        return False
    return True
