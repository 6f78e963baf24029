"""asyncua's server without any service that changes something: network clients can only read.

The library decides by user roles and by each node's access level, and answers a client on an unencrypted channel even if only encrypted
ones are offered (it needs that channel for discovery). Here the services themselves are closed for every external session, and with known
certificates a session is activated only on a channel encrypted with one of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.address_space import AddressSpace
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.server.user_managers import UserManager
from cryptography import x509

from abbe.service.plant.opcua.setup import in_force

MAX_CONNECTIONS = 20
MAX_SUBSCRIPTIONS = 40
ACTIVATION_S = 10.0
READING = ua.AccessLevel.CurrentRead.mask | ua.AccessLevel.HistoryRead.mask


class ClientSession(InternalSession):
    """A client's session."""

    async def write(self, params: ua.WriteParameters) -> list[ua.StatusCode]:
        """Refuse every write."""
        return [ua.StatusCode(ua.StatusCodes.BadNotWritable) for _ in params.NodesToWrite]

    async def call(self, params: list[ua.CallMethodRequest]) -> list[ua.CallMethodResult]:
        """Refuse every call."""
        return [ua.CallMethodResult(ua.StatusCode(ua.StatusCodes.BadNotExecutable)) for _ in params]

    async def add_nodes(self, params: Any) -> Any:
        """Refuse."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    async def delete_nodes(self, params: Any) -> Any:
        """Refuse."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    async def add_references(self, params: Any) -> Any:
        """Refuse."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    async def delete_references(self, params: Any) -> Any:
        """Refuse."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    async def history_update(self, params: Any) -> Any:
        """Refuse."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    def activate_session(self, params: ua.ActivateSessionParameters, peer_certificate: bytes | None) -> ua.ActivateSessionResult:
        """Activate a session; if certificates are known, only on a channel encrypted with one of them."""
        server = self.iserver
        if isinstance(server, ReadOnlyServer) and server.trusted is not None:
            server.must_be_known(peer_certificate)
        return super().activate_session(params, peer_certificate)


class _Readers(UserManager):
    """Gives every authenticated client the role of a reader, and no client more."""

    def __init__(self, trusted: Mapping[bytes, x509.Certificate] | None) -> None:
        self._trusted = trusted

    def get_user(self, iserver: InternalServer, username: str | None = None, password: str | None = None, certificate: Any = None) -> Any:
        """Return a reader, or None if the certificate is not known."""
        if username is not None or (self._trusted is not None and certificate not in self._trusted):
            return None
        return User(role=UserRole.User)


class ReadOnlyServer(InternalServer):
    """The internal server.

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
        """Refuse: this is no discovery server, and this service needs no session."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)


def seal(space: AddressSpace) -> int:
    """Remove write access from every node and execute access from every method, the standard's own too; return how many."""
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
