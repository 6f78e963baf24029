"""The status bar of every screen: state of the machine, alarms, and the button that stops it."""

from __future__ import annotations

from dataclasses import dataclass

from abbe.service.domain.progress import RunningCheck
from abbe.service.queries.status import AlarmSummary, Status
from abbe.service.sequences.control import State
from abbe.service.web.frame import current

SIGNS = {State.PAUSED: "‖", State.PAUSING: "‖", State.SUSPENDED: "‖", State.STOPPING: "■", State.ABORTING: "■", "asking": "◆"}
"""Shapes of the states of a measurement; any other state is shown as running."""


@dataclass(frozen=True, slots=True)
class Strip:
    """Content of the status bar: shape, words and style (``calm``, ``busy``, ``bad``) of the state, and the alarms.

    ``alarms``: number of open alarms; ``first``: the one for the line below the bar; ``attention``: what needs a person now.
    """

    sign: str
    text: str
    kind: str
    machine: str = ""
    job: RunningCheck | None = None
    alarms: int = 0
    first: AlarmSummary | None = None
    attention: str = ""


def strip_of(status: Status | None) -> Strip:
    """The status bar of a status; without one the state is not known, and Stop works all the same."""
    frame = current()
    if status is None:
        return Strip("?", frame.translate("strip.unknown"), "bad")
    waiting = [one for one in status.alarms if one.state in {"raised", "cleared"}]
    first = min(waiting, key=lambda one: (one.state != "raised", -one.alarm), default=None)
    sign, text, kind = _state(status)
    attention = next(iter(status.attention), "")
    return Strip(sign, text, kind, status.machine, status.job, len(status.alarms), first, attention)


def _state(status: Status) -> tuple[str, str, str]:
    frame = current()
    if status.job is not None:
        state = status.job.state
        return SIGNS.get(state, "▶"), frame.state("measuring", state), "busy"
    if any(device.state == "fault" for device in status.devices):
        return "✖", frame.translate("strip.fault"), "bad"
    return "○", frame.translate("home.idle"), "calm"
