"""Capabilities of a controller for a safe push, and the pushes that they allow (reliability.md 3.1)."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Flags of one controller. Each is proved by its own commissioning test; an unproved one is False."""

    two_banks: bool = False
    swap_compares: bool = False
    """Activation is refused when CRC or generation are not the expected ones."""
    generation: bool = False
    boot_id: bool = False
    interlocks: bool = False
    """Activation is refused by the controller itself when the machine moves or an interlock is open."""
    lease: bool = False
    can_disable: bool = False
    """One bank: compensation can be switched off, and drives-off is confirmed."""

    @property
    def level(self) -> int:
        """L3: unattended by policy. L2: attended. L1: attended, drives off. L0: read and export only."""
        flags = [getattr(self, f.name) for f in fields(self) if f.name != "can_disable"]
        if all(flags):
            return 3
        if self.two_banks and self.generation and self.boot_id:
            return 2
        return 1 if self.can_disable else 0


NEEDS_ATTENDANCE = (
    "this controller was not proved to compare and swap, keep a lease and watch its axes: a person who approves has to be at the machine"
)


def objection(level: int, *, attended: bool) -> str:
    """Why a push is not allowed at this level; empty if it is."""
    if level >= 3:
        return ""
    if level == 2:
        return "" if attended else NEEDS_ATTENDANCE
    if level == 1:
        return "this controller has one bank: pushes with drives off are not built yet; export the table as a file"
    return "this controller can only be read: export the table as a file"
