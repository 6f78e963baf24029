"""The OPC UA server as a part of the service: updates its values once a second, accepts none. Its failures affect nothing else."""

from __future__ import annotations

import asyncio
import gc
import math
import socket
from datetime import datetime

import structlog
from asyncua import Server, ua
from asyncua.common.connection import TransportLimits

from abbe.service.clock import Clock
from abbe.service.config_schema import OpcUa
from abbe.service.errors import ConfigError, StoreError
from abbe.service.plant.facts import FactsSource
from abbe.service.plant.opcua.picture import picture_of
from abbe.service.plant.opcua.readonly import ReadOnlyServer, seal
from abbe.service.plant.opcua.setup import trusted
from abbe.service.plant.opcua.space import NAMESPACE, Space

log = structlog.get_logger("abbe.opcua")

PERIOD_S = 1.0
AGAIN_S = 30.0
BUFFER_BYTES = 65_535
MESSAGE_BYTES = 4 * 2**20


class OpcUaServer:
    """Shows one machine.

    Parameters
    ----------
    setup : OpcUa
        Address, certificates and clients; checked (`abbe.service.plant.opcua.setup.check_opcua`).
    source : FactsSource
        Facts to show.
    clock : Clock
        Pauses and time stamps.
    machine, version : str
        Name of the machine; version of this program.
    """

    def __init__(self, setup: OpcUa, source: FactsSource, clock: Clock, machine: str, version: str) -> None:
        self._setup, self._source, self._clock = setup, source, clock
        self._machine, self._version = machine, version
        self.port = 0
        """TCP port; 0 while it does not listen."""
        self.listening = asyncio.Event()
        self.sealed = 0
        """Number of write and execute rights removed from the standard's own nodes."""
        self._built: tuple[Server, Space] | None = None

    async def prepare(self) -> None:
        """Build the address space, before anything moves: it takes a second or two and blocks the event loop for parts of one."""
        self._built = await self._build()
        gc.freeze()  # some hundred thousand permanent objects: without this, every full collection would visit them, for 0.2 s

    async def run(self, stop: asyncio.Event) -> None:
        """Serve until ``stop`` or until cancelled. If it cannot listen, it logs that and tries again every half minute."""
        while not stop.is_set():
            try:
                await self._serve(stop)
            except (OSError, ConfigError) as trouble:
                log.error("opc ua cannot be served; trying again", host=self._setup.host, port=self._setup.port, reason=str(trouble))
                await self._pause(AGAIN_S, stop)

    async def _serve(self, stop: asyncio.Event) -> None:
        if self._setup.port:  # fail now rather than after a second of building the address space, at every attempt
            family = socket.AF_INET6 if ":" in self._setup.host else socket.AF_INET
            socket.create_server((self._setup.host, self._setup.port), family=family).close()
        server, space = self._built or await self._build()
        self._built = None
        await server.start()
        try:
            assert server.bserver is not None
            self.port = server.bserver.port
            log.info("opc ua served", host=self._setup.host, port=self.port, encrypted=self._setup.guarded, sealed=self.sealed)
            self.listening.set()
            while not stop.is_set():
                await self._pause(PERIOD_S, stop)
                await self._show(space)
                await self._tell_time(server)
        finally:
            self.listening.clear()
            self.port = 0
            await server.stop()

    async def _build(self) -> tuple[Server, Space]:
        server = await self._make()
        space = Space(server, await server.register_namespace(NAMESPACE), self._machine)
        await self._show(space)
        self.sealed = seal(server.iserver.aspace)
        return server, space

    async def _make(self) -> Server:
        setup = self._setup
        server = Server(iserver=ReadOnlyServer(trusted(setup.clients) if setup.guarded else None))
        server.application_type = ua.ApplicationType.Server
        server.name, server.manufacturer_name, server.product_uri = f"Abbe {self._machine}", "Abbe", "urn:abbe"
        chunks = math.ceil(MESSAGE_BYTES / BUFFER_BYTES)
        server.limits = TransportLimits(BUFFER_BYTES, BUFFER_BYTES, chunks, MESSAGE_BYTES)
        await server.init()
        await server.set_application_uri("urn:abbe:" + "".join(c if c.isalnum() or c in "-_." else "_" for c in self._machine))
        await server.set_build_info("urn:abbe", "Abbe", "Abbe", self._version, "", self._clock.utc())
        host = f"[{setup.host}]" if ":" in setup.host else setup.host
        server.set_endpoint(f"opc.tcp://{host}:{setup.port}/abbe/")
        encrypted = ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt
        policies = [] if setup.guarded else [ua.SecurityPolicyType.NoSecurity]
        server.set_security_policy([*policies, encrypted] if setup.certificate else policies)
        if setup.certificate:
            try:
                await server.load_certificate(setup.certificate)
                await server.load_private_key(setup.key)
            except (ValueError, TypeError) as wrong:
                raise ConfigError(f"[opcua] certificate {setup.certificate}, key {setup.key}: {wrong}", "give PEM files") from None
        return server

    async def _show(self, space: Space) -> None:
        try:
            facts = await self._source.facts()
        except StoreError as trouble:
            if await space.show_stale(self._clock.utc()):
                log.warning("facts not available; the last ones are shown as such", reason=trouble.detail)
            return
        await space.show(picture_of(facts), facts.now_utc)

    async def _tell_time(self, server: Server) -> None:
        now: datetime = self._clock.utc()
        node = server.get_node(ua.NodeId(ua.ObjectIds.Server_ServerStatus))
        status = await node.read_value()
        status.CurrentTime = now
        await server.write_attribute_value(node.nodeid, ua.DataValue(ua.Variant(status, ua.VariantType.ExtensionObject)))
        current = ua.NodeId(ua.ObjectIds.Server_ServerStatus_CurrentTime)
        await server.write_attribute_value(current, ua.DataValue(ua.Variant(now, ua.VariantType.DateTime)))

    async def _pause(self, seconds: float, stop: asyncio.Event) -> None:
        nap = asyncio.create_task(self._clock.sleep(seconds), name="opcua pause")
        wake = asyncio.create_task(stop.wait(), name="opcua stop")
        try:
            await asyncio.wait({nap, wake}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            nap.cancel()
            wake.cancel()
