"""Log of a host's commands to the controller, with times: the oracle of tests about commands after an event."""

from dataclasses import dataclass

MOTION = ("move", "path_clear", "path_start", "reset_alarm", "fifo")
HOLDS = ("run", "hold", "abort")


@dataclass(frozen=True, slots=True)
class Command:
    """One write as it arrived: ``time_s`` since the controller was switched on; ``moving``: whether the axes moved just before it."""

    time_s: float
    kind: str
    args: tuple[int, ...]
    moving: bool

    @property
    def moves(self) -> bool:
        """Whether it starts, feeds or frees a motion. Stopping does not count."""
        return self.kind in MOTION or (self.kind == "run" and self.moving)


@dataclass(frozen=True, slots=True)
class TableAccess:
    """One attempt to change a bank, the active table or the lease, as it arrived, in order.

    ``kind``: write, seal, activate, lease or release; one that carried an executed number and did nothing: "stale". ``bank``: which;
    ``first`` and ``words``: what was written where. ``by``: owner that a command names, 0 for a write, which names none. ``taken``: whether
    the controller did it. ``owner``: who held the lease just before; ``active``, ``gen``: active bank and generation just after.
    """

    time_s: float
    kind: str
    bank: int
    first: int
    words: tuple[int, ...]
    by: int
    taken: bool
    owner: int
    active: int
    gen: int
