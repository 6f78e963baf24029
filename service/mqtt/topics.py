"""The topics of one machine. ``{prefix}/{machine}/state`` is retained; the others are not."""

from __future__ import annotations

from dataclasses import dataclass

from abbe.service.errors import ConfigError

_LEVEL = 100
_FORBIDDEN = "+#\0"


@dataclass(frozen=True, slots=True)
class Topics:
    """Topics of one machine's messages.

    Parameters
    ----------
    prefix : str
        One or more levels, for example ``plant/abbe``.
    machine : str
        Name of the machine; becomes one level, see `level`.
    """

    prefix: str
    machine: str

    def __post_init__(self) -> None:
        if not self.prefix or self.prefix.startswith(("/", "$")) or self.prefix.endswith("/") or set(self.prefix) & set(_FORBIDDEN):
            raise ConfigError(
                f"[mqtt] topic_prefix {self.prefix!r} cannot be part of a topic", "use levels such as plant/abbe, without + # or $"
            )

    @property
    def state(self) -> str:
        """Retained: online, measuring or offline. The broker itself publishes offline when the service vanishes (last will)."""
        return f"{self.prefix}/{level(self.machine)}/state"

    @property
    def verification(self) -> str:
        """One message for every check."""
        return f"{self.prefix}/{level(self.machine)}/verification"

    @property
    def alarm(self) -> str:
        """One message for each event that a person should look at."""
        return f"{self.prefix}/{level(self.machine)}/alarm"


def level(name: str) -> str:
    """Return ``name`` as one topic level: letters, digits, ``-``, ``_`` and ``.`` stay, everything else becomes ``_``."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name)[:_LEVEL] or "_"


def client_id(machine: str) -> str:
    """Return the client identifier, always the same for a machine.

    After a crash the broker must replace the old connection by the new one; otherwise the old one's last will would publish offline while
    the new one is connected.
    """
    return f"abbe-{level(machine)}"
