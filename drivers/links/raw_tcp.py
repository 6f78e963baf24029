"""A plain TCP connection to a serial device server."""

from __future__ import annotations

import asyncio
import socket

from abbe.drivers.errors import LinkDown
from abbe.drivers.links.urls import SocketUrl

_CONNECT_S = 5.0


async def connected(url: SocketUrl) -> socket.socket:
    """Connect.

    Raises
    ------
    LinkDown
        Refused, unreachable, or no answer within 5 s.
    """
    # pyserial's own socket:// connects blockingly, which would freeze every other device of the service for seconds
    try:
        async with asyncio.timeout(_CONNECT_S):
            return await _connect_any(url)
    except TimeoutError:
        raise LinkDown(str(url), "open", f"no connection within {_CONNECT_S:g} s", "address right? device and network on?") from None
    except OSError as error:
        raise LinkDown(str(url), "open", str(error), "address and port right? device server running?") from error


async def _connect_any(url: SocketUrl) -> socket.socket:
    # a name may stand for several addresses (localhost: ::1 and 127.0.0.1) of which only one is served
    loop = asyncio.get_running_loop()
    refused = OSError(f"{url.host} has no address")
    for family, kind, protocol, _, address in await loop.getaddrinfo(url.host, url.port, type=socket.SOCK_STREAM):
        sock = socket.socket(family, kind, protocol)
        connected = False
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            await loop.sock_connect(sock, address)
            connected = True
        except OSError as error:
            refused = error
        finally:
            if not connected:
                sock.close()
        if connected:
            return sock
    raise refused
