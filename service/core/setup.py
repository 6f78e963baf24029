"""What the service is to do, taken from the machine file: everything that `abbe.service.serve` is wired from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from abbe.service.capture.live import LiveFeed
from abbe.service.channel.messages import PAGE_MEMORY_MB, MachineSummary
from abbe.service.clock import Clock
from abbe.service.core.orders import MeasureCampaign, OrderActions
from abbe.service.core.push_recovery import Recover
from abbe.service.devices.urls import control_of
from abbe.service.domain.schedule import Schedule, Window
from abbe.service.mqtt.broker import Broker
from abbe.service.mqtt.topics import Topics
from abbe.service.plant.opcua.setup import OpcUaSetup
from abbe.service.report.report_parts import Rules
from abbe.service.scheduler.alarm_manager import Duties
from abbe.service.scheduler.ports import Check, Readiness
from abbe.service.scheduler.ready import AlwaysReady
from abbe.service.scheduler.store import ServiceStore
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
        Where everything is told.
    topics : Topics
        Under which names.
    host, port : str, int
        Where the page is.
    check : callable
        Given the open store, returns ``check(recipe, progress)``.
    maintenance : tuple of Window
        Nothing starts by itself in these.
    ready : callable
        Given the clock, returns who knows the preconditions.
    names : tuple of str
        Under which other computers ask for the page.
    certificate, key : str
        PEM files of the page; empty: plain HTTP.
    opcua : OpcUaSetup or None
        Where OPC UA clients may read; checked.
    recipes : tuple of str
        What a person may start at any time, besides those of the timetable.
    recover : callable, optional
        Given the open store, returns how what an earlier end has left open is closed.
    behind_tls : bool
        A reverse proxy on this computer takes off the TLS.
    rules : Rules
        Limits, certificates and temperatures that reports add to the data.
    duties : callable, optional
        Given the open store, what is done about alarms; None: none are raised.
    table : callable, optional
        Given the open store, how the table in force is looked at; None: nobody watches it.
    live : LiveFeed, optional
        What ``check`` shows of its paths, for the page.
    told : MachineTold, optional
        What the page calculates dry runs from.
    actions : callable, optional
        Given the open store, what a person can order of tables; None: nothing.
    page_memory_mb : int
        Most that the page's process gets, MiB.
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
    host: str
    port: int
    check: Callable[[ServiceStore], Check]
    maintenance: tuple[Window, ...] = ()
    ready: Callable[[Clock], Readiness] = lambda _: AlwaysReady()
    names: tuple[str, ...] = ()
    certificate: str = ""
    key: str = ""
    opcua: OpcUaSetup | None = None
    recipes: tuple[str, ...] = ()
    recover: Callable[[ServiceStore], Recover] | None = None
    behind_tls: bool = False
    rules: Rules = field(default_factory=Rules)
    duties: Callable[[ServiceStore], Duties] | None = None
    table: Callable[[ServiceStore], LookAtTable] | None = None
    live: LiveFeed | None = None
    told: MachineSummary | None = None
    actions: Callable[[ServiceStore], OrderActions] | None = None
    page_memory_mb: int = PAGE_MEMORY_MB
    campaigns: tuple[str, ...] = ()
    campaign: Callable[[ServiceStore], MeasureCampaign] | None = None
    warnings: tuple[str, ...] = ()
    """What the machine file says that is possible and rarely meant: logged once the service serves."""

    @property
    def control(self) -> str:
        """Identity of the machine's control (`control_of`); empty where there is none."""
        return control_of(self.devices.get("cnc"))
