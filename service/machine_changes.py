"""Changes of the machine file that a person makes on the page: which, by whom, what they loosen, and how the file is replaced.

The file stays the only owner of its values: a change edits its text, and the parser of the file judges the result before it is written.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

from abbe.service.config import LoadedMachine, parse_machine, text_of
from abbe.service.domain.machine_file import FileEdit
from abbe.service.errors import ConfigError
from abbe.service.toml_text import NotEditableError, edited
from abbe.service.users.roles import Permission

RIGHTS: Mapping[str, Permission] = MappingProxyType(
    {
        "issuer": Permission.CONFIGURE,
        "item": Permission.CONFIGURE,
        "schedule": Permission.CONFIGURE,
        # What a table may do and which measurement counts is judged by those who approve tables.
        "limits": Permission.APPROVE,
        "verify": Permission.APPROVE,
        "calibration": Permission.APPROVE,
    }
)
"""Sections that can be changed, with the right for it. Addresses, geometry, store, page, keys and users' rights cannot."""
Looser = Literal["more", "less", "wider", "added", "later", "stated"]
LOOSER: Mapping[str, Looser] = MappingProxyType(
    {
        **dict.fromkeys(
            (
                "limits.table_value_um",
                "limits.table_change_um",
                "limits.table_step_um",
                "limits.table_beyond_percent",
                "limits.table_walk_um",
                "limits.measurement_age_h",
                "limits.feed_mm_min",
                "limits.suspend_s",
                "verify.body_diagonal_um",
                "verify.helix_rms_um",
            ),
            "more",
        ),
        "limits.two_people": "less",
        "limits.settle_s": "less",
        "limits.temperature_c": "wider",
        "limits.run_temperature_c": "wider",
        "limits.continue_after": "added",
        "calibration.ballbar": "later",
        "calibration.laser": "later",
        "calibration.artefact": "later",
        "calibration.room": "later",
        "calibration.room_temperature_c": "stated",
    }
)
"""What makes a value allow more than before. ``more``, ``less``: a larger, a smaller one; ``wider``: a range that leaves the old one, or
none any more; ``added``: further entries; ``later``: a later day, or a first one; ``stated``: any value that is stated."""


@dataclass(frozen=True, slots=True)
class Change:
    """A value in force before and after, as JSON has it. ``looser``: the new one allows more."""

    key: str
    old: Any
    new: Any
    looser: bool

    def __str__(self) -> str:
        """The change in one phrase, e.g. ``verify.helix_rms_um 5.0 -> 6.0``."""
        return f"{self.key} {_shown(self.old)} → {_shown(self.new)}"


def section_of(key: str) -> str:
    """The section of a dotted key."""
    return key.partition(".")[0].partition("[")[0]


def changed(loaded: LoadedMachine, edits: Sequence[FileEdit]) -> LoadedMachine:
    """Return the machine file with other values, as its own parser reads it; nothing is written.

    Raises
    ------
    ConfigError
        A value is refused by the parser, comes from the environment, or cannot be changed in this text.
    """
    text = text_of(loaded.body)
    for edit in edits:
        if any(origin == "environment" and _same(key, edit.key) for key, origin in loaded.origins.items()):
            raise ConfigError(f"{edit.key} comes from the environment of the service", "change it there")
        try:
            text = edited(text, edit.key, json.loads(edit.value))
        except ValueError as err:
            what = str(err) if isinstance(err, NotEditableError) else f"{edit.key} has no value that can be read"
            raise ConfigError(what, "nothing was changed") from None
    body = text.replace("\n", "\r\n") if b"\r\n" in loaded.body else text
    return parse_machine(loaded.path, body.encode())


def _same(key: str, other: str) -> bool:
    return key == other or key.startswith((f"{other}.", f"{other}["))


def differences(old: LoadedMachine, new: LoadedMachine) -> tuple[Change, ...]:
    """The values in force that differ, in the order of the documentation; schedules are compared by their names."""
    before, after = ({_by_name(one, key): value for key, value, _ in one.values()} for one in (old, new))
    keys = [key for key in dict.fromkeys([*before, *after]) if before.get(key) != after.get(key)]
    return tuple(Change(key, before.get(key), after.get(key), is_looser(key, before.get(key), after.get(key))) for key in keys)


def _by_name(loaded: LoadedMachine, key: str) -> str:
    for number, entry in enumerate(loaded.machine.schedule, start=1):
        key = key.replace(f"schedule[{number}].", f"schedule[{entry.name}].", 1)
    return key


def is_looser(key: str, old: Any, new: Any) -> bool:
    """Whether a value allows more than another one did, by `LOOSER`; a key without a rule loosens nothing."""
    match LOOSER.get(key):
        case "more":
            return bool(new > old)
        case "less":
            return bool(new < old)
        case "added":
            return not set(new) <= set(old)
        case "wider" if old is not None:
            return new is None or new[0] < old[0] or new[1] > old[1]
        case "later":
            return new is not None and (old is None or new > old)
        case "stated":
            return new is not None
    return False


def _shown(value: Any) -> str:
    return "–" if value in (None, "") else value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
