"""Is the device behind a Modbus link the one whose register map we hold? Asked before anything is believed or written."""

from __future__ import annotations

from collections.abc import Mapping

from drivers.errors import WrongDevice
from drivers.links.words import CANARY_F32_BITS, CANARY_I32

_SWAPPED = {0x03040102: "the two registers of a value are swapped", 0x02010403: "the bytes inside a register are swapped"}


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
    canary, bits = counts["CANARY_I32"], counts["CANARY_F32"]
    if canary != CANARY_I32 or bits != CANARY_F32_BITS:
        detail = f"the canary registers hold {canary & 0xFFFFFFFF:08x} {bits:08x} instead of {CANARY_I32:08x} {CANARY_F32_BITS:08x}"
        remedy = _SWAPPED.get(canary & 0xFFFFFFFF, "is this address and unit number really that device?")
        raise WrongDevice(device, "identify", detail, remedy)
    if counts["MAP_VER"] != map_version:
        detail = f"register map version {counts['MAP_VER']} instead of {map_version}"
        raise WrongDevice(device, "identify", detail, "install the matching firmware, or the matching version of this program")
