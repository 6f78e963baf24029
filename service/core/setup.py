"""Setup of the service, from the machine file: all that `abbe.service.serve` needs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from abbe.service.capture.live import LiveFeed
from abbe.service.channel.messages import MachineSummary
from abbe.service.clock import Clock
from abbe.service.config import LoadedMachine
from abbe.service.config_schema import OpcUa, Web
from abbe.service.core.orders import MeasureCampaign, OrderActions
from abbe.service.core.push_recovery import Recover
from abbe.service.core.table_watch import LookAtTable
from abbe.service.domain.machine import Rules, control_of
from abbe.service.domain.machine_file import MachineFileSummary
from abbe.service.domain.schedule import Schedule, Window
from abbe.service.mqtt.broker import Broker, Topics
from abbe.service.scheduler.alarm_manager import Duties
from abbe.service.scheduler.ports import Check, Readiness
from abbe.service.scheduler.ready import AlwaysReady
from abbe.service.storage.store import Store


@dataclass(frozen=True, slots=True)
class MachineFileSource:
    """The machine file in force; ``prepare``: makes the setup of the service from a file, or refuses the file as a start would."""

    loaded: LoadedMachine
    prepare: Callable[[LoadedMachine], ServiceSetup]


@dataclass(frozen=True, slots=True)
class ServiceSetup:
    """Setup of the service, from the machine file. Callables that take a store get the open store of the service.

    Parameters
    ----------
    machine : str
        Name of the machine.
    doc : dict
        The machine object that the store keeps.
    devices : mapping of str to str
        URL of each device by its role.
    schedules : tuple of Schedule
        The timetable.
    store_url : str
        URL of the database.
    broker : Broker or None
        The MQTT broker.
    topics : Topics
        Topics of the published messages.
    web : Web
        The section ``[web]`` of the machine file, with absolute paths.
    check : callable
        Given the store, returns ``check(recipe, progress, control)``.
    maintenance : tuple of Window
        Windows in which nothing starts by itself.
    ready : callable
        Given the clock, returns the check of preconditions.
    opcua : OpcUa or None
        The section ``[opcua]`` of the machine file, checked.
    recipes : tuple of str
        Recipes that a person may start at any time, besides those of the timetable.
    recover : callable, optional
        Given the store, returns the recovery of runs and pushes that an earlier process left unfinished.
    rules : Rules
        Limits, certificates and temperatures that reports add to the data.
    duties : callable, optional
        Given the store, returns the reactions of the service to alarms; None: it raises no alarms.
    table : callable, optional
        Given the store, returns the reader of the table in force; None: it is not watched.
    live : LiveFeed, optional
        Samples of the running path, for the page.
    summary : MachineSummary, optional
        The page's data for dry runs.
    actions : callable, optional
        Given the store, returns the orders for tables that a person can give; None: no orders.
    campaigns : tuple of str
        Full campaigns that a person may start, if ``campaign`` is given.
    campaign : callable, optional
        Given the store, returns the function that measures and solves a full campaign and proposes tables.
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
    stated: MachineFileSummary | None = None
    """The machine file, for the page that shows it."""
    warnings: tuple[str, ...] = ()
    """Unusual but possible values of the machine file: logged once the service is up."""
    source: MachineFileSource | None = None
    """The machine file, for changes on the page; None: the page changes no file."""

    @property
    def control(self) -> str:
        """Identity of the machine's control (`control_of`); empty without a control."""
        return control_of(self.devices.get("cnc"))
