"""Does this Modbus reply answer that request? Pure checks on the raw bytes, before the library sees them.

The library accepts replies with a wrong count, a wrong echo or another function code, and silently waits on some damaged headers;
so every byte whose value the request already fixes is compared here.
"""

from __future__ import annotations

_TCP_HEADER = 7
_READ = (3, 4)

EXCEPTION_TEXT = {
    1: "illegal function",
    2: "illegal data address (or not writable)",
    3: "illegal data value",
    4: "device failure",
    5: "acknowledged, still busy with it",
    6: "busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target does not respond",
}


def tcp_mismatch(sent: bytes, heard: bytes) -> str:
    """Compare what arrived so far on Modbus TCP with what was asked.

    Parameters
    ----------
    sent : bytes
        The whole request frame.
    heard : bytes
        All bytes that arrived since it was sent; may still be incomplete.

    Returns
    -------
    str
        What is wrong, or ``""`` as long as nothing is.
    """
    if len(heard) >= 2 and heard[:2] != sent[:2]:
        return f"transaction id {int.from_bytes(heard[:2], 'big')} instead of {int.from_bytes(sent[:2], 'big')}"
    if len(heard) >= 4 and heard[2:4] != b"\x00\x00":
        return f"protocol id {int.from_bytes(heard[2:4], 'big')} instead of 0"
    if len(heard) >= _TCP_HEADER and heard[6] != sent[6]:
        return f"unit {heard[6]} instead of {sent[6]}"
    complaint = _pdu_mismatch(sent[_TCP_HEADER:], heard[_TCP_HEADER:])
    if complaint or len(heard) <= _TCP_HEADER:
        return complaint
    size, expected = int.from_bytes(heard[4:6], "big"), 1 + _pdu_size(sent[_TCP_HEADER:], heard[_TCP_HEADER])
    if size != expected:
        return f"length {size} instead of {expected}"
    if len(heard) > 6 + size:
        return f"{len(heard) - 6 - size} bytes too many"
    return ""


def rtu_mismatch(sent: bytes, heard: bytes) -> str:
    """Compare what arrived so far on Modbus RTU with what was asked; the check sum is the library's business.

    Parameters
    ----------
    sent : bytes
        The whole request frame.
    heard : bytes
        All bytes that arrived since it was sent; may still be incomplete.

    Returns
    -------
    str
        What is wrong, or ``""`` as long as nothing is.
    """
    if heard and heard[0] != sent[0]:
        return f"unit {heard[0]} instead of {sent[0]}"
    complaint = _pdu_mismatch(sent[1:-2], heard[1:])
    if complaint or len(heard) < 2:
        return complaint
    extra = len(heard) - (1 + _pdu_size(sent[1:-2], heard[1]) + 2)
    return f"{extra} bytes too many" if extra > 0 else ""


def _pdu_size(asked: bytes, function: int) -> int:
    if function & 0x80:
        return 2
    return 2 + 2 * int.from_bytes(asked[3:5], "big") if asked[0] in _READ else 5


def _pdu_mismatch(asked: bytes, heard: bytes) -> str:
    if not heard:
        return ""
    if heard[0] not in (asked[0], asked[0] | 0x80):
        return f"function {heard[0]} instead of {asked[0]}"
    if heard[0] & 0x80:
        return ""
    if asked[0] in _READ:
        expected = 2 * int.from_bytes(asked[3:5], "big")
        return f"{heard[1]} data bytes instead of {expected}" if len(heard) >= 2 and heard[1] != expected else ""
    if len(heard) >= 3 and heard[1:3] != asked[1:3]:
        return f"echo of address {int.from_bytes(heard[1:3], 'big')} instead of {int.from_bytes(asked[1:3], 'big')}"
    if len(heard) >= 5 and heard[3:5] != asked[3:5]:
        return f"echo of count {int.from_bytes(heard[3:5], 'big')} instead of {int.from_bytes(asked[3:5], 'big')}"
    return ""
