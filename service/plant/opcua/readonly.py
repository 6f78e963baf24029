"""asyncua's server without everything that changes something: whoever comes over the network reads, and nothing else.

The library decides by user roles and by each node's access level, and answers a client on an unencrypted channel even where only encrypted
ones are offered (it needs that channel for discovery). Here the services themselves are closed for every session from outside, and with
known certificates a session is activated only on a channel that was encrypted with one of them.
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
        """Write nothing."""
        return [ua.StatusCode(ua.StatusCodes.BadNotWritable) for _ in params.NodesToWrite]

    async def call(self, params: list[ua.CallMethodRequest]) -> list[ua.CallMethodResult]:
        """Call nothing."""
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
        """Let somebody in: with known certificates, by an encrypted channel of one of them only."""
        server = self.iserver
        if isinstance(server, ReadOnlyServer) and server.trusted is not None:
            server.must_be_known(peer_certificate)
        return super().activate_session(params, peer_certificate)


class _Readers(UserManager):
    """Everybody who proved what is asked of him reads; nobody is more."""

    def __init__(self, trusted: Mapping[bytes, x509.Certificate] | None) -> None:
        self._trusted = trusted

    def get_user(self, iserver: InternalServer, username: str | None = None, password: str | None = None, certificate: Any = None) -> Any:
        """Return a reader, or None for somebody whose certificate is not known."""
        if username is not None or (self._trusted is not None and certificate not in self._trusted):
            return None
        return User(role=UserRole.User)


class ReadOnlyServer(InternalServer):
    """The inside of the server.

    Parameters
    ----------
    trusted : mapping of bytes to certificate, or None
        Who may come, by the DER bytes of his certificate. None: everybody who can reach us (this computer), anonymously.
    """

    def __init__(self, trusted: Mapping[bytes, x509.Certificate] | None) -> None:
        super().__init__(user_manager=_Readers(trusted))
        self.trusted = trusted
        self.supported_tokens = (ua.AnonymousIdentityToken,) if trusted is None else (ua.X509IdentityToken,)
        self.allow_remote_admin = False
        self.disabled_clock = True  # its loop sleeps a second through every stop; ours writes the time
        self.max_connections = MAX_CONNECTIONS
        self.max_subscriptions = MAX_SUBSCRIPTIONS
        self.max_pending_activation_seconds = ACTIVATION_S

    def must_be_known(self, certificate: bytes | None) -> None:
        """Refuse a channel without encryption, or of somebody who is not known, or whose certificate has run out."""
        known = (self.trusted or {}).get(certificate or b"")
        if known is None:
            raise ServiceError(ua.StatusCodes.BadCertificateUntrusted if certificate else ua.StatusCodes.BadSecurityModeInsufficient)
        if not in_force(known):
            raise ServiceError(ua.StatusCodes.BadCertificateTimeInvalid)

    def create_session(self, name: str, user: Any = None, external: bool = False) -> InternalSession:
        """Return a session; one from outside can only read."""
        return ClientSession(self, self.aspace, self.subscription_service, name, user=User(role=UserRole.Anonymous), external=external)

    def register_server(self, server: Any, conf: Any = None) -> None:
        """Refuse: this is no discovery server, and the service needs no session."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)


def seal(space: AddressSpace) -> int:
    """Take from every node the right to write and from every method the right to be called, the standard's own too; return how many."""
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
