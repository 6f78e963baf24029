"""Addresses of the devices of a machine, without any code that connects to them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from urllib.parse import parse_qs, urlsplit

UNIT = "1"
"""Modbus unit of a URL that names none."""


@dataclass(frozen=True, slots=True)
class DeviceUrls:
    """Device URLs of a machine; None: not connected."""

    cnc: str | None = None
    ballbar: str | None = None
    laser: str | None = None
    fixture: str | None = None

    def named(self) -> tuple[str, ...]:
        """Roles that have an address."""
        return tuple(role for role, url in asdict(self).items() if url is not None)


def control_of(url: str | None) -> str:
    """Return the identity of a control for the push journal; empty for no URL.

    The register map has no serial number, and a boot id changes at every start, so the address identifies the control: `address_of`, plus
    the Modbus unit if it is not 1, because a gateway has several controls behind one address. One control under two addresses (a host name
    and its IP) counts as two: docs/decisions/0030-whose-table-it-is.md.
    """
    address = address_of(url)
    unit = parse_qs((url or "").partition("?")[2]).get("unit", [UNIT])[0].strip().lstrip("0") or "0"
    return address if unit == UNIT or not address else f"{address}?unit={unit}"


def address_of(url: str | None) -> str:
    """Return the address in a URL for the machine lock: scheme, host in lower case and port (or the path of a line), without the query.

    All units behind one address share one lock.
    """
    if not url:
        return ""
    plain = url.partition("?")[0]
    parts = urlsplit(plain)
    return f"{parts.scheme}://{parts.netloc.lower()}{parts.path.rstrip('/')}" if parts.scheme else plain
