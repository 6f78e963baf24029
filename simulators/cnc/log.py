"""Log of a host's commands to the controller, with times, for tests that check which commands follow an event."""

from dataclasses import dataclass

MOTION = ("move", "touch", "path_clear", "path_start", "reset_alarm", "fifo")
HOLDS = ("run", "hold", "abort")


@dataclass(frozen=True, slots=True)
class Command:
    """One write as it arrived: ``time_s`` since the controller was switched on; ``moving``: whether a motion was under way (or held)."""

    time_s: float
    kind: str
    args: tuple[int, ...]
    moving: bool

    @property
    def moves(self) -> bool:
        """Whether the command is a motion or path command, or resumes a motion; hold and abort do not count."""
        return self.kind in MOTION or (self.kind == "run" and self.moving)


@dataclass(frozen=True, slots=True)
class TableAccess:
    """One attempt to change a bank, the active table or the lease, as it arrived.

    ``kind``: write, seal, activate, lease or release, or "stale" for a command that was ignored because its number was not the next one.
    ``bank``, ``first``, ``words``: bank, first register and words of a write; for a command, ``words`` are its number and its result
    (stale: its code). ``by``: owner named in the command, 0 for a write. ``taken``: whether the controller executed it. ``owner``: owner of
    the lease just before; ``active``, ``gen``: active bank and generation just after.
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
