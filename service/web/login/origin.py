"""Origin of a request: sending page, client address, and TLS."""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection

from abbe.service.web.listening import is_local


def is_tls(request: HTTPConnection, *, behind_tls: bool) -> bool:
    """Whether the visitor's connection uses TLS."""
    return behind_tls or request.scope.get("scheme") in {"https", "wss"}


def address_of(request: HTTPConnection, *, behind_tls: bool) -> str:
    """The visitor's address.

    Behind our reverse proxy, which runs on this computer, this is the last address in ``X-Forwarded-For``: the proxy appended that one, but
    the visitor may have written the others.
    """
    address = request.client.host if request.client else ""
    if behind_tls and is_local(address):
        forwarded = ",".join(request.headers.getlist("x-forwarded-for")).rpartition(",")[2].strip()
        try:
            return str(ipaddress.ip_address(forwarded))
        except ValueError:
            return address
    return address


def is_ours(request: HTTPConnection, origin: str | None, *, behind_tls: bool) -> bool:
    """Whether one of our own pages sent the request."""
    if request.headers.get("sec-fetch-site", "same-origin") not in {"same-origin", "none"}:
        return False
    try:
        parts = urlsplit(origin or "")
    except ValueError:
        return False
    # Even without the option a reverse proxy may have terminated TLS.
    schemes = {"https"} if is_tls(request, behind_tls=behind_tls) else {"http", "https"}
    return parts.scheme in schemes and bool(parts.netloc) and parts.netloc.lower() == request.headers.get("host", "").lower()
