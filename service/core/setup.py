"""What the service is to do, taken from the machine file: everything that `abbe.service.serve` is wired from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from abbe.service.capture.live import LiveFeed
from abbe.service.channel.messages import MachineSummary
from abbe.service.clock import Clock
from abbe.service.config_schema import OpcUa, Web
from abbe.service.core.orders import MeasureCampaign, OrderActions
from abbe.service.core.push_recovery import Recover
from abbe.service.devices.urls import control_of
from abbe.service.domain.schedule import Schedule, Window
from abbe.service.mqtt.broker import Broker
from abbe.service.mqtt.topics import Topics
from abbe.service.report.report_parts import Rules
from abbe.service.scheduler.alarm_manager import Duties
from abbe.service.scheduler.ports import Check, Readiness
from abbe.service.scheduler.ready import AlwaysReady
from abbe.service.storage.store import Store
from abbe.service.tables.in_force import LookAtTable


@dataclass(frozen=True, slots=True)
class ServiceSetup:
    """What the service is to do, taken from the machine file.

    Parameters
    ----------
    machine : str
        Name of the machine.
    doc : dict
        Its description as the store keeps it.
    devices : mapping of str to str
        Role and URL.
    schedules : tuple of Schedule
        The timetable.
    store_url : str
        Where everything is kept.
    broker : Broker or None
        Where results are published.
    topics : Topics
        Under which names.
    web : Web
        Where the page is served, to whom, with which certificate: the section of the machine file, its files with their whole paths.
    check : callable
        Given the open store, returns ``check(recipe, progress)``.
    maintenance : tuple of Window
        Nothing starts by itself in these.
    ready : callable
        Given the clock, returns who knows the preconditions.
    opcua : OpcUa or None
        Where OPC UA clients may read; checked.
    recipes : tuple of str
        What a person may start at any time, besides those of the timetable.
    recover : callable, optional
        Given the open store, returns how what an earlier end has left open is closed.
    rules : Rules
        Limits, certificates and temperatures that reports add to the data.
    duties : callable, optional
        Given the open store, what is done about alarms; None: none are raised.
    table : callable, optional
        Given the open store, how the table in force is looked at; None: it is not watched.
    live : LiveFeed, optional
        What ``check`` shows of its paths, for the page.
    summary : MachineSummary, optional
        What the page calculates dry runs from.
    actions : callable, optional
        Given the open store, what a person can order of tables; None: nothing.
    campaigns : tuple of str
        Full campaigns that a person may start, if ``campaign`` is there.
    campaign : callable, optional
        Given the open store, how one is measured, solved and proposed.
    """

    machine: str
    doc: dict[str, Any]
    devices: Mapping[str, str]
    schedules: tuple[Schedule, ...]
    store_url: str
    broker: Broker | None
    topics: Topics
    web: Web
    check: Callable[[Store], Check]
    maintenance: tuple[Window, ...] = ()
    ready: Callable[[Clock], Readiness] = lambda _: AlwaysReady()
    opcua: OpcUa | None = None
    recipes: tuple[str, ...] = ()
    recover: Callable[[Store], Recover] | None = None
    rules: Rules = field(default_factory=Rules)
    duties: Callable[[Store], Duties] | None = None
    table: Callable[[Store], LookAtTable] | None = None
    live: LiveFeed | None = None
    summary: MachineSummary | None = None
    actions: Callable[[Store], OrderActions] | None = None
    campaigns: tuple[str, ...] = ()
    campaign: Callable[[Store], MeasureCampaign] | None = None
    warnings: tuple[str, ...] = ()
    """What the machine file says that is possible and rarely meant: logged once the service serves."""

    @property
    def control(self) -> str:
        """Identity of the machine's control (`control_of`); empty where there is none."""
        return control_of(self.devices.get("cnc"))
