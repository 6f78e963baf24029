"""The status bar of every screen: state of the machine, alarms, and the button that stops it."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot

from abbe.service.domain.progress import RunningCheck
from abbe.service.domain.service_records import Signal
from abbe.service.queries.status import AlarmSummary, Status
from abbe.service.sequences.control import State
from abbe.service.web import language
from abbe.service.web.frame import current

SIGNS = {State.PAUSED: "‖", State.PAUSING: "‖", State.SUSPENDED: "‖", State.STOPPING: "■", State.ABORTING: "■", "asking": "◆"}
"""Shapes of the states of a measurement; any other state is shown as running."""


@dataclass(frozen=True, slots=True)
class Strip:
    """Content of the status bar: shape, words and style (``calm``, ``busy``, ``bad``) of the state, and the alarms.

    ``alarms``: number of open alarms that are not shelved; ``first``: the unseen one for the line below the bar, ``line``: its text;
    ``attention``: what needs a person now.
    """

    sign: str
    text: str
    kind: str
    machine: str = ""
    job: RunningCheck | None = None
    alarms: int = 0
    first: AlarmSummary | None = None
    line: str = ""
    attention: str = ""


def strip_of(status: Status | None) -> Strip:
    """Return the status bar; without a status it says that the state is unknown. Stop works in both cases."""
    frame = current()
    if status is None:
        return Strip("?", frame.translate("strip.unknown"), "bad")
    asking = [one for one in status.alarms if not one.is_shelved(status.now_utc)]
    unseen = [one for one in asking if one.state in {"raised", "cleared"}]
    first = min(unseen, key=lambda one: (one.state != "raised", one.priority, -one.alarm), default=None)
    sign, text, kind = _state(status)
    attention = next(iter(status.attention), "")
    return Strip(sign, text, kind, status.machine, status.job, len(asking), first, "" if first is None else alarm_line(first), attention)


def alarm_line(one: AlarmSummary) -> str:
    """Signals that raised or held an alarm, or its figures, in the reader's language and units."""
    return "; ".join(_signal(signal) for signal in one.signals) or one.text


def _signal(one: Signal) -> str:
    frame = current()
    name, unit = language.figure(frame.lang, one.figure)
    value, u = frame.with_u(one.value, one.expanded / 2.0, unit)
    change = ("", "")
    if one.baseline is not None:
        change = frame.with_u(one.value - one.baseline, hypot(one.expanded / 2.0, one.baseline_u or 0.0), unit)
    known = {
        "figure": name,
        "value": value,
        "u": u,
        "unit": frame.unit(unit),
        "limit": frame.length(f"{one.limit:g}", unit),
        "change": " ± ".join(change),
    }
    text = frame.state("alarm.signal", one.kind)
    return text.format(**known) if text != one.kind else one.text


def _state(status: Status) -> tuple[str, str, str]:
    frame = current()
    if status.job is not None:
        state = status.job.state
        return SIGNS.get(state, "▶"), frame.state("measuring", state), "busy"
    if any(device.state == "fault" for device in status.devices):
        return "✖", frame.translate("strip.fault"), "bad"
    return "○", frame.translate("home.idle"), "calm"
