"""What a control can do, as its commissioning has proved, and the pushes that this allows."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Flags of one controller. Each is proved by its own commissioning test; an unproved one is False."""

    two_banks: bool = False
    swap_compares: bool = False
    """The controller refuses an activation when CRC or generation are not the expected ones."""
    generation: bool = False
    boot_id: bool = False
    interlocks: bool = False
    """The controller itself refuses an activation while the machine moves or an interlock is open."""
    lease: bool = False
    can_disable: bool = False
    """With one table only (`abbe.drivers.api.OneBank`), proved by ``abbe comp commission --one-bank``: the control refuses writes while the
    table acts, and a switch with a wrong CRC; switched off, it says so."""

    @property
    def level(self) -> int:
        """Allowed pushes. 3: unattended; 2: attended; 1: attended, one table; 0: none, the controller can only be read."""
        flags = [getattr(self, f.name) for f in fields(self) if f.name != "can_disable"]
        if all(flags):
            return 3
        if self.two_banks and self.generation and self.boot_id:
            return 2
        return 1 if self.can_disable else 0


NEEDS_ATTENDANCE = (
    "this controller is not proved to compare and swap, keep a lease and watch its axes: a person who approves has to be at the machine"
)


def objection(level: int, *, attended: bool) -> str:
    """Why a push is not allowed at this level; empty if it is."""
    if level >= 3:
        return ""
    if level in (1, 2):
        return "" if attended else NEEDS_ATTENDANCE
    return "this controller can only be read: export the table as a file"
