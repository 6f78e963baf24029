"""Changes of the machine file that a person makes on the page: which, by whom, what they loosen, and how the file is replaced.

The file stays the only owner of its values: a change edits its text, and the parser of the file judges the result before it is written.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from types import MappingProxyType
from typing import Any

from abbe.service.config import LoadedMachine, parse_machine, text_of
from abbe.service.config_schema import Calibration, Limits, Verify
from abbe.service.domain.machine_file import FileEdit, Looser, loosening
from abbe.service.domain.people import Permission
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import ConfigError
from abbe.service.toml_text import NotEditableError, edited

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
"""Sections that the page can change, each with the right that a user needs. It cannot change addresses, geometry, store, page, keys and
rights."""
LOOSER: Mapping[str, Looser] = MappingProxyType(
    {
        f"{section}.{key}": when
        for section, table in (("limits", Limits), ("verify", Verify), ("calibration", Calibration), ("schedule", Schedule))
        for key, when in loosening(table).items()
    }
)
"""Keys that may allow more, and when. Of a new schedule only the name is judged; a removed schedule allows no more than before."""
UNRAISED = ("skip", "none")
_IS_LOOSER: Mapping[Looser, Callable[[Any, Any], bool]] = MappingProxyType(
    {
        "more": lambda old, new: new > old,
        "higher": lambda old, new: old is not None and (new is None or new > old),
        "less": lambda old, new: new < old,
        "added": lambda old, new: not set(new) <= set(old),
        "wider": lambda old, new: old is not None and (new is None or new[0] < old[0] or new[1] > old[1]),
        "later": lambda old, new: new is not None and (old is None or new > old),
        "stated": lambda old, new: new is not None,
        "changed": lambda old, new: new != old,
        "raised": lambda old, new: new != old and new not in UNRAISED,
        "dropped": lambda old, new: old not in (new, "any"),
    }
)
NUMBERED = re.compile(r"schedule\[([1-9]\d*)\]\.")


@dataclass(frozen=True, slots=True)
class ValueChange:
    """A value in force before and after, as JSON has it. ``looser``: the new one allows more."""

    key: str
    old: Any
    new: Any
    looser: bool

    def __str__(self) -> str:
        """The change in one phrase, e.g. ``verify.helix_rms_um 5.0 → 6.0``."""
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
            text = edited(text, edit.key, _value(edit))
            text.encode()
        except (ValueError, RecursionError) as err:
            what = str(err) if isinstance(err, NotEditableError) else f"{edit.key} has no value that can be read"
            raise ConfigError(what, "nothing was changed") from None
    body = text.replace("\n", "\r\n") if b"\r\n" in loaded.body else text
    return parse_machine(loaded.path, body.encode())


def _value(edit: FileEdit) -> Any:
    """Return the wanted value; for a key that holds a last day, its text as a date. Raises ValueError, RecursionError, ConfigError."""
    value = json.loads(edit.value)
    if LOOSER.get(edit.key) != "later" or not isinstance(value, str):
        return value
    try:
        return date.fromisoformat(value)
    except ValueError:
        raise ConfigError(f"{edit.key}: expected a day such as 2027-05-31, got {value!r}", "nothing was changed") from None


def _same(key: str, other: str) -> bool:
    return key == other or key.startswith((f"{other}.", f"{other}["))


def differences(old: LoadedMachine, new: LoadedMachine) -> tuple[ValueChange, ...]:
    """The values in force that differ, in the order of the documentation; schedules are compared by their names. A section in which only
    a secret differs is a change of the section, without values."""
    before, after = ({_by_name(one, key): value for key, value, _ in one.values()} for one in (old, new))
    keys = [key for key in dict.fromkeys([*before, *after]) if before.get(key) != after.get(key)]
    found = [ValueChange(key, before.get(key), after.get(key), is_looser(key, before.get(key), after.get(key))) for key in keys]
    told = {section_of(key) for key in keys}
    first, then = (one.machine.model_dump(mode="json") for one in (old, new))
    return (*found, *(ValueChange(name, "", "", looser=False) for name in then if name not in told and first[name] != then[name]))


def _by_name(loaded: LoadedMachine, key: str) -> str:
    found = NUMBERED.match(key)
    return key if found is None else f"schedule[{loaded.machine.schedule[int(found[1]) - 1].name}].{key[found.end() :]}"


def is_looser(key: str, old: Any, new: Any) -> bool:
    """Whether a value allows more than another one did, by `LOOSER`; a key without a rule loosens nothing."""
    if section_of(key) == "schedule":
        key = f"schedule.{key.rpartition('].')[2]}"
        if new is None or (old is None and key != "schedule.name"):  # of a schedule that is removed, or that is new
            return False
    return key in LOOSER and bool(_IS_LOOSER[LOOSER[key]](old, new))


def _shown(value: Any) -> str:
    return "–" if value in (None, "") else value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
