"""Prometheus metrics of the store, the core and this process at ``/metrics``."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Iterator

from fastapi import FastAPI
from fastapi.responses import Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector

from abbe.service.channel.messages import Snapshot
from abbe.service.domain.people import Permission
from abbe.service.errors import CoreUnavailable
from abbe.service.storage.store import Store
from abbe.service.verification.verified_by import verified_by
from abbe.service.web.core_link.core_line import CoreLine
from abbe.service.web.login.access import needs

VERDICTS = ("pass", "fail", "cannot tell")


class _MetricsCollector(Collector):
    def __init__(self, store: Store, core: CoreLine, machine: str, control: str) -> None:
        self._store, self._core, self._machine, self._control = store, core, machine, control

    def collect(self) -> Iterable[Metric]:
        yield from self._of_store()
        try:
            snapshot = self._core.snapshot()
        except CoreUnavailable:
            yield GaugeMetricFamily("abbe_core_up", "Whether the core process answers", 0.0)
            return
        yield GaugeMetricFamily("abbe_core_up", "Whether the core process answers", 1.0)
        yield from _of_core(snapshot)

    def _of_store(self) -> Iterator[Metric]:
        checks = CounterMetricFamily("abbe_checks", "Checks of the whole history by verdict", labels=["verdict"])
        counts = dict.fromkeys(VERDICTS, 0) | self._store.verifications.counts(self._machine)
        for verdict, number in sorted(counts.items()):
            checks.add_metric([verdict], number)
        yield checks
        slots = CounterMetricFamily("abbe_slots_not_run", "Slots of the timetable that were not run, by reason", labels=["why"])
        states = self._store.slots.counts(self._machine)
        for why in ("missed", "skipped", "interrupted"):
            slots.add_metric([why], sum(number for state, number in states.items() if state.startswith(why)))
        yield slots
        yield GaugeMetricFamily("abbe_outbox_waiting", "Messages that wait for the broker", self._store.outbox.count())
        known = verified_by(self._store, self._machine, control=self._control)
        about = "1: a check, or its own push, has measured the table in force; 0: nothing has measured it yet"
        yield GaugeMetricFamily("abbe_table_verified", about, float(known.state == "verified"))
        checks_now = self._store.verifications.of_machine(self._machine, 1) if known.holds else []
        last = next(iter(checks_now), None)
        figures = GaugeMetricFamily(
            "abbe_last_figure", "Figures of the last check with the table in force; the unit is at the end of the name", labels=["figure"]
        )
        for name, value in sorted((last.doc.get("values") or {}).items()) if last is not None else ():
            if value is not None:
                figures.add_metric([name], value)
        yield figures


def _of_core(snapshot: Snapshot) -> Iterator[Metric]:
    devices = GaugeMetricFamily(
        "abbe_device_connected", "1: in use, or answered when last asked; 0: fault, or not used yet", labels=["role"]
    )
    for device in snapshot.devices:
        devices.add_metric([device.role], float(device.state in {"in use", "answered"}))
    yield devices
    yield GaugeMetricFamily("abbe_measuring", "Whether a check runs", float(snapshot.check is not None))
    yield GaugeMetricFamily("abbe_mqtt_connected", "Whether the broker is connected", float(snapshot.mqtt_connected))
    yield GaugeMetricFamily("abbe_attention", "How many things need a person", len(snapshot.attention))
    yield GaugeMetricFamily("abbe_core_resident_memory_bytes", "Resident memory of the core process", snapshot.core_rss_bytes)
    yield CounterMetricFamily("abbe_web_restarts", "How often the web process was started again", snapshot.web_restarts)


def add_metrics(app: FastAPI, store: Store, core: CoreLine, machine: str, control: str = "") -> None:
    """Add the route `/metrics` to the application. It needs the permission ``read``, like the home page."""
    registry = CollectorRegistry()
    registry.register(_MetricsCollector(store, core, machine, control))
    ProcessCollector(namespace="abbe_web", registry=registry)

    @app.get("/metrics", include_in_schema=False)
    @needs(Permission.READ)
    async def metrics() -> Response:
        return Response(await asyncio.to_thread(generate_latest, registry), media_type=CONTENT_TYPE_LATEST)
