"""Fields of the forms that change the machine file: the values that they show, and the changes that a sent form requests.

A field only converts typed text to JSON. The parser of the machine file alone checks bounds and allowed words.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from abbe.service.config_schema import Calibration, Limits, Verify
from abbe.service.domain.machine_file import FileEdit, MachineFileSummary
from abbe.service.domain.schedule import Needs, Schedule
from abbe.service.web.frame import current

Kind = Literal["text", "optional", "number", "maybe", "yes", "date", "range", "choice", "many", "times"]
"""``optional``: a text that may be absent; ``maybe``: a number that may be absent; ``range``: two numbers; ``yes``: yes or no;
``many``: boxes to tick; ``times``: days and a time of day, a cron expression, or nothing."""
_NUMBER = re.compile(r"-?(0|[1-9]\d*)(\.\d+)?([eE][+-]?\d+)?")
_KEY = re.compile(r"\b(issuer|item|verify|limits|calibration|schedule)(?:\[([^\]]*)\])?(\.[a-z_.]*[a-z_])")
ENDS = ("low", "high")
DAYS = {"daily": "*", "workdays": "1-5", "mon": "1", "tue": "2", "wed": "3", "thu": "4", "fri": "5", "sat": "6", "sun": "0"}
"""Choices for the days of a schedule, and their field of a cron expression."""
_TIME = re.compile(r"([01]\d|2[0-3]):[0-5]\d")
_ONE_TIME = re.compile(r"(\d|[1-5]\d) (\d|1\d|2[0-3]) \* \* (\*|1-5|[0-6])")


@dataclass(frozen=True, slots=True)
class Field:
    """One value of the machine file in a form. ``options``: what can be chosen; ``required``: never empty."""

    key: str
    kind: Kind
    options: tuple[str, ...] = ()
    required: bool = False


def _fields(section: str, **kinds: Kind) -> tuple[Field, ...]:
    return tuple(Field(f"{section}.{name}", kind) for name, kind in kinds.items())


def _every(section: str, table: type, *, only: Sequence[str] = (), but: Sequence[str] = ()) -> tuple[Field, ...]:
    """A field for each key of a table of the machine file, or for some of them; the type of the key decides how it is shown."""
    hints = get_type_hints(table)
    return tuple(_of_type(f"{section}.{key}".lstrip("."), hints[key]) for key in only or hints if key not in but and key != "model_config")


def _of_type(key: str, hint: Any) -> Field:
    inner = [one for one in get_args(hint) if one is not NoneType] if get_origin(hint) in (Union, UnionType) else [hint]
    absent, kind = inner != [hint], inner[0]
    if get_origin(kind) is Literal:
        return Field(key, "choice", get_args(kind))
    if get_origin(kind) is list:
        return Field(key, "many", get_args(get_args(kind)[0]))
    if get_origin(kind) is tuple:
        return Field(key, "range")
    kinds: dict[Any, Kind] = {bool: "yes", date: "date", str: "optional" if absent else "text"}
    return Field(key, kinds.get(kind, "maybe" if absent else "number"))


PLACES = ("laboratory", "customer", "laboratoryBranch", "customerBranch", "other")
ISSUER = (
    *(Field(f"issuer.{name}", "text", required=True) for name in ("laboratory", "city", "country", "person")),
    *_fields("issuer", address="text", accreditation="text", procedure="text", prefix="text", customer="text", customer_address="text"),
    Field("issuer.place", "choice", PLACES),
)
ITEM = _fields("item", maker="text", model="text", serial="text", place="text")
VERIFY = _every("verify", Verify)
MEASURE = _every("limits", Limits, only=("feed_mm_min", "temperature_c", "run_temperature_c", "continue_after", "suspend_s", "settle_s"))
PUSH = tuple(one for one in _every("limits", Limits) if one not in MEASURE)
CERTIFICATES = _every("calibration", Calibration)
LABORATORY, LIMITS = (*ISSUER, *ITEM), (*VERIFY, *PUSH, *MEASURE)
TIMES = (
    Field("name", "text", required=True),
    Field("recipe", "choice"),
    Field("cron", "times", (*DAYS, "expression", "interval")),
    Field("every_h", "maybe"),
    Field("first", "optional"),
    Field("timezone", "text", required=True),
)
SCHEDULE = (*TIMES, *_every("", Schedule, but=[one.key for one in TIMES] + ["needs"]), *_every("needs", Needs))
"""Fields of one schedule; their keys follow ``schedule[N].``."""
SCHEDULE_DEFAULTS = {"timezone": "UTC", "recipe": "quick-check", "catch_up": "skip", "on_alarm": "none", "needs.operator": "any"}


def schedule_fields(number: int, recipes: Sequence[str]) -> tuple[Field, ...]:
    """The fields of the schedule with a number, from 1."""
    options = {"recipe": tuple(recipes)}
    return tuple(replace(one, key=f"schedule[{number}].{one.key}", options=options.get(one.key, one.options)) for one in SCHEDULE)


@dataclass(frozen=True, slots=True)
class ShownField:
    """A field with its value as the form shows it. ``texts``: one text, or the two ends of a range, or what is ticked, or days, time and
    expression; ``fixed``: the environment of the service sets the value."""

    field: Field
    texts: tuple[str, ...]
    fixed: bool = False

    @property
    def label(self) -> str:
        """Key of the field's name in the catalogues, without the number of a schedule."""
        return re.sub(r"\[\d+\]", "", self.field.key)

    @property
    def options(self) -> tuple[str, ...]:
        """What can be chosen, including a present value that is no longer an option."""
        return tuple(dict.fromkeys((*self.field.options, *(text for text in self.texts if text and self.field.kind == "choice"))))


def shown_fields(fields: Sequence[Field], stated: MachineFileSummary) -> list[ShownField]:
    """The fields with the values in force."""
    known = {one.key: one for one in stated.values}
    found = []
    for field in fields:
        one = known.get(field.key)
        blank = one is None or (one.origin == "default" and field.kind in {"optional", "maybe", "times"})
        value = None if one is None or blank else json.loads(one.value)
        if value is None and field.kind == "times":
            value = None if one is None else ""
        elif value is None:
            value = SCHEDULE_DEFAULTS.get(field.key.partition("].")[2])
        found.append(ShownField(field, _texts(field, value), one is not None and one.origin == "environment"))
    return found


def _texts(field: Field, value: Any) -> tuple[str, ...]:
    if value is None and field.kind == "range":
        return ("", "")
    if field.kind == "times":
        return _times(value)
    if isinstance(value, list):
        return tuple(_text(one) for one in value)
    return ("" if value is None else _text(value),)


class FormError(ValueError):
    """Fields of a form contradict each other. ``key``: key of the remedy in the catalogues."""

    def __init__(self, key: str) -> None:
        super().__init__(key)
        self.key = key


def _times(cron: str | None) -> tuple[str, str, str]:
    """Days, time of day and expression with which a form shows a cron expression; empty: interval; None: new schedule, nothing chosen."""
    if not cron:
        return "" if cron is None else "interval", "", ""
    found = _ONE_TIME.fullmatch(cron)
    if found is None:
        return "expression", "", cron
    days = next(name for name, known in DAYS.items() if known == found[3])
    return days, f"{int(found[2]):02}:{int(found[1]):02}", ""


def _cron(key: str, expression: str, form: Mapping[str, str]) -> str | None:
    """The cron expression that a form requests. Raises FormError unless the form fills in the chosen kind of rule, and no other."""
    days, time = form.get(f"{key}.days"), form.get(f"{key}.time", "").strip()
    interval = form.get(f"{key.removesuffix('cron')}every_h", "").strip()
    if days is None:
        return expression or None
    told = {"days": bool(time), "expression": bool(expression), "interval": bool(interval)}
    way = "days" if days in DAYS else days
    if [name for name, given in told.items() if given] != [way] or (way == "days" and not _TIME.fullmatch(time)):
        raise FormError("admin.times")
    if way != "days":
        return expression or None
    hour, minute = map(int, time.split(":"))
    return f"{minute} {hour} * * {DAYS[days]}"


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.15g}" if isinstance(value, float) else str(value)


def edits_of(fields: Sequence[Field], form: Mapping[str, str], stated: MachineFileSummary) -> tuple[FileEdit, ...]:
    """The changes that a sent form requests: values that differ from those in force. Fields that the form lacks change nothing.

    Raises FormError if fields contradict each other.
    """
    known = {one.key: one for one in stated.values}
    found = []
    for field in fields:
        if not any(name in form for name in _names(field)):
            continue
        sent, one = _sent(field, form), known.get(field.key)
        now = None if one is None or (sent is None and one.origin == "default") else json.loads(one.value)
        if sent != now and not (sent in ("", None) and now in ("", None)):
            found.append(FileEdit(field.key, json.dumps(sent, ensure_ascii=False)))
    return _whole(found, fields, form, known)


def _whole(found: list[FileEdit], fields: Sequence[Field], form: Mapping[str, str], known: Mapping[str, Any]) -> tuple[FileEdit, ...]:
    """Remove a laboratory without any name, even if its place is chosen."""
    if ISSUER[0] in fields:
        named = any(form.get(one.key, "").strip() for one in ISSUER if one.kind == "text")
        if not named and ISSUER[0].key in form:
            others = [edit for edit in found if not edit.key.startswith("issuer.")]
            return (*others, FileEdit("issuer", "null")) if ISSUER[0].key in known else tuple(others)
    return tuple(found)


def _names(field: Field) -> tuple[str, ...]:
    return (field.key, *(f"{field.key}.{end}" for end in ENDS)) if field.kind == "range" else (field.key,)


def _sent(field: Field, form: Mapping[str, str]) -> Any:
    """The value of a field in a form, as JSON; None if empty. Text in place of a number stays text, which the parser refuses."""
    text = form.get(field.key, "").replace("\r\n", "\n").strip()
    match field.kind:
        case "number" | "maybe":
            return _number(text)
        case "yes":
            return text == "yes"
        case "range":
            low, high = (_number(form.get(f"{field.key}.{end}", "").strip()) for end in ENDS)
            return None if low is None and high is None else [low, high]
        case "many":
            return [one for one in field.options if form.get(f"{field.key}.{one}") == "yes"]
        case "times":
            return _cron(field.key, text, form)
        case "date" | "optional":
            return text or None
    return text


def _number(text: str) -> Any:
    plain = text.replace(",", ".")
    return None if not text else json.loads(plain) if _NUMBER.fullmatch(plain) else text


def with_names(text: str) -> str:
    """A text with keys of the machine file replaced by the names of their fields."""
    frame = current()

    def name(found: re.Match[str]) -> str:
        known = frame.state("file", found[1] + found[3])
        return found[0] if known == found[1] + found[3] else f"{known} ({found[2]})" if found[2] else known

    return _KEY.sub(name, text)
