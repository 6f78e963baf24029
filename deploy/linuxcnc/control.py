"""LinuxCNC as the bridge sees it: one snapshot of its state, a few commands, and the HAL items of machine.hal and volumetric.hal."""

from __future__ import annotations

import select
from dataclasses import dataclass
from pathlib import Path

import hal
import linuxcnc
from network import Network, parameters

JOINTS = 3
SWITCH_TRIES, SWITCH_WAIT_S = 5, 0.03
_LOST = (linuxcnc.error, SystemError, RuntimeError)


class ControlGone(Exception):  # noqa: N818 - reads as what it is
    """LinuxCNC has ended."""


@dataclass(frozen=True)
class Snapshot:
    """State of the control at one instant. ``ready``: the control executes nothing and no axis moves; ``refused``:
    its last command ended with an error. Positions are commanded ones, mm."""

    estop: bool
    drives_on: bool
    homed: bool
    ready: bool
    refused: bool
    in_position: bool
    interpreting: bool
    spindle: bool
    door_open: bool
    remote: bool
    override_percent: int
    position_mm: tuple[float, float, float]
    line: int
    queue: int
    probe_ready: bool
    deflected: bool
    tripped: bool
    probed_mm: tuple[float, float, float]
    """Commanded position at which the probe tripped in the last probing move, if it tripped (``tripped``)."""


class Control:
    """A running LinuxCNC with the HAL files of this folder.

    Raises
    ------
    ControlGone
        The control does not run, or does not have three joints in mm.
    """

    def __init__(self) -> None:
        try:
            self._status, self._command, self._errors = linuxcnc.stat(), linuxcnc.command(), linuxcnc.error_channel()
            self._status.poll()
        except _LOST as error:
            raise ControlGone(f"no status yet ({error})") from None
        self._sent = -1
        if self._status.joints != JOINTS or self._status.linear_units != 1.0:
            raise ControlGone("no control with three joints in mm yet")
        # Only now: whoever asks for HAL before the control has made it would make one himself.
        self._component = hal.component("abbe-bridge")
        self._component.ready()
        period_ns = linuxcnc.ini(self._status.ini_filename).find("EMCMOT", "SERVO_PERIOD")
        self.latch_period_us = round(float(period_ns) * 1e-3) if period_ns else 1000  # motion's own default
        axes = self._status.axis[:JOINTS]
        self.low_mm = tuple(float(a["min_position_limit"]) for a in axes)
        self.high_mm = tuple(float(a["max_position_limit"]) for a in axes)
        self.fastest_mm_s = float(self._status.max_velocity)

    def snapshot(self) -> Snapshot:
        """Read the control's state.

        Raises
        ------
        ControlGone
            The control has ended.
        """
        self._poll()
        s = self._status
        # The planner is done some servo periods before the joints are: what they are told counts.
        still = all(self._get(f"joint.{n}.vel-cmd") == 0.0 for n in range(JOINTS))
        over = s.state in (linuxcnc.RCS_DONE, linuxcnc.RCS_ERROR)  # after a refused line the control stays in error until the next one
        idle = over and s.interp_state == linuxcnc.INTERP_IDLE and s.echo_serial_number >= self._sent
        return Snapshot(
            estop=s.task_state == linuxcnc.STATE_ESTOP or not self._get("abbe-estop-ok"),
            drives_on=s.task_state == linuxcnc.STATE_ON,
            homed=all(s.homed[:JOINTS]),
            ready=bool(idle and still and s.inpos and s.queue == 0),
            refused=s.state == linuxcnc.RCS_ERROR,
            in_position=bool(s.inpos and still),
            interpreting=s.interp_state != linuxcnc.INTERP_IDLE,
            spindle=bool(s.spindle[0]["enabled"]),
            door_open=bool(self._get("abbe-door-open")),
            remote=bool(self._get("abbe-remote")),
            override_percent=round(s.feedrate * 100),
            position_mm=tuple(float(self._get(f"joint.{n}.pos-cmd")) for n in range(JOINTS)),
            line=int(s.motion_line),
            queue=int(s.queue),
            probe_ready=bool(self._get("abbe-probe-ready")),
            deflected=bool(self._get("motion.probe-input")),
            tripped=bool(s.probe_tripped),
            probed_mm=tuple(float(v) for v in s.probed_position[:JOINTS]),
        )

    def complaints(self) -> list[str]:
        """Messages of the control to its operator since the last call."""
        told = []
        while (entry := self._errors.poll()) is not None:
            told.append(str(entry[1]).strip())
        return told

    # ---- motion ------------------------------------------------------------------------------------------------------------------

    def mdi(self, line: str) -> None:
        """Execute one line of G-code."""
        self._mode(linuxcnc.MODE_MDI)
        self._command.mdi(line)
        self._sent = self._command.serial

    def work_offset_mm(self) -> tuple[float, float, float] | None:
        """Zero of the active work coordinates, mm, to which G38 refers; None if these coordinates are rotated."""
        self._poll()
        s = self._status
        return None if s.rotation_xy else tuple(float(s.g5x_offset[n] + s.g92_offset[n]) for n in range(JOINTS))

    def run(self, program: Path) -> None:
        """Execute a program from its first line."""
        self._mode(linuxcnc.MODE_MDI)  # a program that is open in AUTO mode is not opened anew
        self._mode(linuxcnc.MODE_AUTO)
        self._command.program_open(str(program))
        self._command.wait_complete()
        self._command.auto(linuxcnc.AUTO_RUN, 0)
        self._sent = self._command.serial

    def abort(self) -> None:
        """Stop on the path and discard the rest."""
        self._command.abort()
        self._sent = self._command.serial

    def estop(self) -> None:
        """Go into the e-stop state: the motion ends where it is, and the drives are switched off."""
        self._command.state(linuxcnc.STATE_ESTOP)
        self._sent = self._command.serial

    def switch_on(self) -> None:
        """Leave the e-stop state and switch the drives on, if the control allows it within some tenths of a second."""
        wishes = [(linuxcnc.STATE_ESTOP_RESET, linuxcnc.STATE_ESTOP), (linuxcnc.STATE_ON, linuxcnc.STATE_ESTOP_RESET)]
        for wish, former in wishes:
            for _ in range(SWITCH_TRIES):  # the control looks at its e-stop input now and then only
                self._command.state(wish)
                self._command.wait_complete(SWITCH_WAIT_S)
                self._poll()
                if self._status.task_state != former:
                    break
                select.select([], [], [], SWITCH_WAIT_S)
        self._sent = self._command.serial

    def hold(self, *, on: bool) -> None:
        """Set or release feed hold for any motion."""
        hal.set_p("abbe-feed.in1", str(int(on)))

    def path_output(self, *, on: bool) -> None:
        """Set the "path running" output."""
        hal.set_p("abbe-path.in0", str(int(on)))

    def _mode(self, mode: int) -> None:
        self._command.mode(mode)
        self._command.wait_complete()

    # ---- compensation ------------------------------------------------------------------------------------------------------------

    def load(self, bank: int, network: Network) -> bool:
        """Set the values of a bank's network; return True if every value reads back."""
        wanted = list(parameters(bank, network))
        for name, value in wanted:
            hal.set_p(name, repr(value))
        return all(self._get(name) == value for name, value in wanted)

    def select(self, bank: int) -> bool:
        """Make a network act; return True if the switch confirms it."""
        hal.set_p("abbe-switch.in0", str(bank))
        return int(self._get("abbe-switch.in0")) == bank

    def seen(self) -> bool:
        """Whether another bridge has already run since the control's start. The call leaves a mark for the next bridge."""
        before = bool(self._get("abbe-seen.in0"))
        hal.set_p("abbe-seen.in0", "1")
        return before

    def _get(self, name: str) -> float:
        return hal.get_value(name)

    def _poll(self) -> None:
        # The status stays readable after the control's end: shared memory lasts as long as somebody looks at it.
        if not hal.component_exists("motmod"):
            raise ControlGone("its motion module is unloaded")
        try:
            self._status.poll()
        except _LOST as error:
            raise ControlGone(str(error) or "no status") from None
