"""Where a request comes from: which page sent it, from which address, over TLS or not."""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection

from abbe.service.web.listening import is_local


def is_tls(request: HTTPConnection, *, behind_tls: bool) -> bool:
    """Tell whether it came over TLS, as far as its visitor is concerned."""
    return behind_tls or request.scope.get("scheme") in {"https", "wss"}


def address_of(request: HTTPConnection, *, behind_tls: bool) -> str:
    """The visitor's address.

    Behind our reverse proxy, which runs on this computer, the last one in ``X-Forwarded-For``: the proxy has appended it itself. All before
    it the visitor may have written.
    """
    address = request.client.host if request.client else ""
    if behind_tls and is_local(address):
        said = ",".join(request.headers.getlist("x-forwarded-for")).rpartition(",")[2].strip()
        try:
            return str(ipaddress.ip_address(said))
        except ValueError:
            return address
    return address


def is_ours(request: HTTPConnection, origin: str | None, *, behind_tls: bool) -> bool:
    """Tell whether our own page sent it."""
    if request.headers.get("sec-fetch-site", "same-origin") not in {"same-origin", "none"}:
        return False
    try:
        parts = urlsplit(origin or "")
    except ValueError:
        return False
    # Without the option a reverse proxy may have taken the TLS off all the same.
    schemes = {"https"} if is_tls(request, behind_tls=behind_tls) else {"http", "https"}
    return parts.scheme in schemes and bool(parts.netloc) and parts.netloc.lower() == request.headers.get("host", "").lower()
