"""The OPC UA server as a part of the service: it updates its values once a second and accepts none. Its failures affect nothing else.

asyncua grants access only by user roles and each node's access level. It also answers clients on an unencrypted channel, which it needs for
discovery, even if only encrypted channels are offered. `ClientSession` therefore refuses every service that changes something. If client
certificates are configured, it activates a session only on a channel encrypted with one of them.
"""

from __future__ import annotations

import asyncio
import gc
import math
import socket
from collections.abc import Mapping
from datetime import datetime
from typing import Any

import structlog
from asyncua import Server, ua
from asyncua.common.connection import TransportLimits
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.address_space import AddressSpace
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.server.user_managers import UserManager
from cryptography import x509

from abbe.service.clock import Clock
from abbe.service.config_schema import OpcUa
from abbe.service.errors import ConfigError, StoreError
from abbe.service.plant.gather import FactsSource
from abbe.service.plant.opcua.events import Events
from abbe.service.plant.opcua.setup import in_force, trusted
from abbe.service.plant.opcua.space import NAMESPACE, Space, picture_of
from abbe.service.plant.opcua.types import NodesetBroken, has_companions

MAX_CONNECTIONS = 20
MAX_SUBSCRIPTIONS = 40
ACTIVATION_S = 10.0
READING = ua.AccessLevel.CurrentRead.mask | ua.AccessLevel.HistoryRead.mask


class ClientSession(InternalSession):
    """A client's session, which can only read."""

    async def write(self, params: ua.WriteParameters) -> list[ua.StatusCode]:
        """Refuse every write."""
        return [ua.StatusCode(ua.StatusCodes.BadNotWritable) for _ in params.NodesToWrite]

    async def call(self, params: list[ua.CallMethodRequest]) -> list[ua.CallMethodResult]:
        """Refuse every call."""
        return [ua.CallMethodResult(ua.StatusCode(ua.StatusCodes.BadNotExecutable)) for _ in params]

    async def add_nodes(self, params: Any) -> Any:
        """Refuse to add nodes."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    async def delete_nodes(self, params: Any) -> Any:
        """Refuse to delete nodes."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    async def add_references(self, params: Any) -> Any:
        """Refuse to add references."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    async def delete_references(self, params: Any) -> Any:
        """Refuse to delete references."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    async def history_update(self, params: Any) -> Any:
        """Refuse to change the history."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    def activate_session(self, params: ua.ActivateSessionParameters, peer_certificate: bytes | None) -> ua.ActivateSessionResult:
        """Activate a session; if client certificates are configured, only on a channel encrypted with one of them."""
        server = self.iserver
        if isinstance(server, ReadOnlyServer) and server.trusted is not None:
            server.must_be_known(peer_certificate)
        return super().activate_session(params, peer_certificate)


class _Readers(UserManager):
    """Gives every accepted client the right to read, and no other right."""

    def __init__(self, trusted: Mapping[bytes, x509.Certificate] | None) -> None:
        self._trusted = trusted

    def get_user(self, iserver: InternalServer, username: str | None = None, password: str | None = None, certificate: Any = None) -> Any:
        """Return a reader, or None if the certificate is not known."""
        if username is not None or (self._trusted is not None and certificate not in self._trusted):
            return None
        return User(role=UserRole.User)


class ReadOnlyServer(InternalServer):
    """asyncua's internal server, restricted to reading.

    Parameters
    ----------
    trusted : mapping of bytes to certificate, or None
        Certificates of the clients that may connect, by their DER bytes. None: any program on this computer, anonymously.
    """

    def __init__(self, trusted: Mapping[bytes, x509.Certificate] | None) -> None:
        super().__init__(user_manager=_Readers(trusted))
        self.trusted = trusted
        self.supported_tokens = (ua.AnonymousIdentityToken,) if trusted is None else (ua.X509IdentityToken,)
        self.allow_remote_admin = False
        self.disabled_clock = True  # its loop delays every stop by a second; `OpcUaServer` writes the time
        self.max_connections = MAX_CONNECTIONS
        self.max_subscriptions = MAX_SUBSCRIPTIONS
        self.max_pending_activation_seconds = ACTIVATION_S

    def must_be_known(self, certificate: bytes | None) -> None:
        """Refuse a channel without encryption, with an unknown certificate, or with an expired one."""
        known = (self.trusted or {}).get(certificate or b"")
        if known is None:
            raise ServiceError(ua.StatusCodes.BadCertificateUntrusted if certificate else ua.StatusCodes.BadSecurityModeInsufficient)
        if not in_force(known):
            raise ServiceError(ua.StatusCodes.BadCertificateTimeInvalid)

    def create_session(self, name: str, user: Any = None, external: bool = False) -> InternalSession:
        """Return a session that can only read."""
        return ClientSession(self, self.aspace, self.subscription_service, name, user=User(role=UserRole.Anonymous), external=external)

    def register_server(self, server: Any, conf: Any = None) -> None:
        """Refuse: this is no discovery server. Clients can call this without a session, so `ClientSession` cannot refuse it."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)


def seal(space: AddressSpace) -> int:
    """Remove write access from all nodes and execute access from all methods, also those of the standard; return the number of changes."""
    sealed = 0
    for nodeid in list(space.keys()):
        attributes = space[nodeid].attributes
        for name in (ua.AttributeIds.AccessLevel, ua.AttributeIds.UserAccessLevel):
            level = attributes.get(name)
            if level is not None and level.value is not None and level.value.Value is not None and level.value.Value.Value & ~READING:
                level.value = ua.DataValue(ua.Variant(level.value.Value.Value & READING, ua.VariantType.Byte))
                sealed += 1
        for name in (ua.AttributeIds.Executable, ua.AttributeIds.UserExecutable):
            may = attributes.get(name)
            if may is not None and may.value is not None and may.value.Value is not None and may.value.Value.Value:
                may.value = ua.DataValue(ua.Variant(False, ua.VariantType.Boolean))
                sealed += 1
    return sealed


log = structlog.get_logger("abbe.opcua")

PERIOD_S = 1.0
AGAIN_S = 30.0
BUFFER_BYTES = 65_535
MESSAGE_BYTES = 4 * 2**20


class OpcUaServer:
    """Shows one machine by OPC UA.

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
        self._built: tuple[Server, Space, Events] | None = None

    async def prepare(self) -> None:
        """Build the address space. Call it before anything moves: it takes seconds and blocks the event loop for parts of them."""
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
        server, space, events = self._built or await self._build()
        self._built = None
        await server.start()
        try:
            assert server.bserver is not None
            self.port = server.bserver.port
            log.info("opc ua served", host=self._setup.host, port=self.port, encrypted=self._setup.guarded, sealed=self.sealed)
            self.listening.set()
            while not stop.is_set():
                await self._pause(PERIOD_S, stop)
                await self._show(space, events)
                await self._tell_time(server)
        finally:
            self.listening.clear()
            self.port = 0
            await server.stop()

    async def _build(self) -> tuple[Server, Space, Events]:
        server = await self._make()
        try:
            space = await Space.built(server, await server.register_namespace(NAMESPACE), self._machine, companions=has_companions())
        except NodesetBroken as broken:
            log.error("companion specification cannot be read; the server runs without it", reason=str(broken))
            server = await self._make()
            space = await Space.built(server, await server.register_namespace(NAMESPACE), self._machine, companions=False)
        events = await Events.prepared(server, space.types, space.root, self._clock.utc())
        await self._show(space, events)
        self.sealed = seal(server.iserver.aspace)
        return server, space, events

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

    async def _show(self, space: Space, events: Events) -> None:
        try:
            facts = await self._source.facts()
        except StoreError as trouble:
            if await space.show_stale(self._clock.utc()):
                log.warning("facts not available; the last known values are shown and marked as such", reason=trouble.detail)
            return
        await space.show(picture_of(facts), facts.now_utc)
        await events.show(facts)

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
