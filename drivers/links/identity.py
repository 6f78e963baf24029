"""Is the device behind a Modbus link the one whose register map we hold? Asked before anything is believed or written."""

from __future__ import annotations

from collections.abc import Mapping

from abbe.drivers.errors import WrongDevice
from abbe.drivers.links.words import CANARY_F32_BITS, CANARY_I32

_ORDERS = {"CDAB": (2, 3, 0, 1), "BADC": (1, 0, 3, 2), "DCBA": (3, 2, 1, 0)}
_WORDS = {
    "CDAB": "the two registers of a value are swapped (CDAB)",
    "BADC": "the bytes inside a register are swapped (BADC)",
    "DCBA": "registers and bytes are swapped (DCBA)",
}
_SET_ORDER = "set the device to big-endian, high word first (ABCD)"
_WHO = "is this address and unit number really that device?"
_LONGEST_US = 100 * 365 * 86400 * 10**6


def _order(known: int, found: int) -> str:
    """Which order turns the known value into the one found; empty when none does."""
    data = known.to_bytes(4, "big")
    return next((name for name, places in _ORDERS.items() if bytes(data[i] for i in places) == found.to_bytes(4, "big")), "")


def check_identity(device: str, counts: Mapping[str, int], map_version: int) -> None:
    """Compare the canary registers and the map version with what the protocol demands.

    Parameters
    ----------
    device : str
        For the error text.
    counts : mapping
        Decoded identity block with CANARY_I32, CANARY_F32 (bits) and MAP_VER.
    map_version : int
        The version this driver was written for.

    Raises
    ------
    WrongDevice
        Not the device, another word order, or another map version.
    """
    canary, bits = counts["CANARY_I32"] & 0xFFFFFFFF, counts["CANARY_F32"]
    if canary != CANARY_I32 or bits != CANARY_F32_BITS:
        detail = f"the canary registers hold {canary:08x} {bits:08x} instead of {CANARY_I32:08x} {CANARY_F32_BITS:08x}"
        orders = {"int32": _order(CANARY_I32, canary), "float32": _order(CANARY_F32_BITS, bits)}
        named = [f"{name}: {_WORDS[order]}" for name, order in orders.items() if order]
        raise WrongDevice(device, "identify", "; ".join([detail, *named]), _SET_ORDER if named else _WHO)
    if counts["MAP_VER"] != map_version:
        detail = f"register map version {counts['MAP_VER']} instead of {map_version}"
        raise WrongDevice(device, "identify", detail, "install the matching firmware, or the matching version of this program")


def check_clock(device: str, device_us: int) -> None:
    """Refuse a 64-bit device time that no device can have: then the four registers stand in another order than the 32-bit canaries.

    Parameters
    ----------
    device_us : int
        Time since the device was switched on, us.

    Raises
    ------
    WrongDevice
        More than 100 years.
    """
    if device_us > _LONGEST_US:
        detail = f"its clock says {device_us:#018x} us since it was switched on: int64: the registers of 64-bit values are swapped"
        raise WrongDevice(device, "identify", detail, _SET_ORDER)
