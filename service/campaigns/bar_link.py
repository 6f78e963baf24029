"""The ball-bar's box before and after a run: found again when its cable was pulled or it was switched on anew, or the run does not begin.

The broken run is closed as it is, and the test goes on as a run of its own. What a box has read before it was restarted is joined to
nothing; a path that only lost its cable may go on where it was, if somebody vouches for what is mounted
(abbe.service.sequences.path_resume).
"""

from __future__ import annotations

from abbe.drivers.api import DeviceInfo
from abbe.drivers.errors import DriverError, LinkDown, Rebooted, ReplyTimeout
from abbe.service.devices.session import Session
from abbe.service.errors import RunInterrupted
from abbe.service.sequences.control import Control, State
from abbe.service.sequences.interlocks import Suspending
from abbe.service.sequences.journal import WAITS, Journal
from abbe.service.sequences.needed import BEFORE_S
from abbe.service.sequences.runner import Runner
from abbe.service.sequences.steps import ReadBar, RecordPath, TestPlan

BALLBAR = "ballbar"
"""The word in ``[limits] continue_after``."""
MOST_BREAKS = 5
"""So often a test begins again because the box was lost; then a person has to look at it."""
BREAKS = (LinkDown, ReplyTimeout, Rebooted)


async def bar_ready(session: Session, test: TestPlan) -> DeviceInfo | None:
    """Before a run: if it needs the ball-bar, the same box answers, and reads as it did when it was first met.

    Raises
    ------
    DriverError
        It is not there, is another one, or a person has to look at it.
    """
    if session.ballbar is None or not any(isinstance(step, RecordPath | ReadBar) for step in test.steps):
        return None
    return await session.ballbar.make_ready(within_s=BEFORE_S)


class BarBreaks:
    """What becomes of a test whose runs are ended by the loss of the box.

    Parameters
    ----------
    session : Session
        Open devices.
    control : Control
        Whoever waits can be stopped.
    suspending : Suspending
        Whether and how long to wait for the box; without ``ballbar`` in its conditions the error ends the measurement.
    """

    def __init__(self, session: Session, control: Control, suspending: Suspending) -> None:
        self._bar, self._control, self._suspending = session.ballbar, control, suspending
        self._count = 0

    async def wait(self, error: DriverError, runner: Runner, journal: Journal) -> None:
        """After a run that ended by this error: returns when nothing is to be done about it here.

        Raises
        ------
        RunInterrupted
            The box is back: the test begins again, in a run of its own. Whoever plugged it in may have touched what is mounted.
        DriverError
            It did not come back in time, or another one did.
        Stopped, Aborted
            That was asked for meanwhile.
        """
        if self._bar is None or error.device != self._bar.name or not isinstance(error, BREAKS):
            return
        self._count += 1
        if BALLBAR not in self._suspending.conditions or self._count > MOST_BREAKS:
            return
        self._control.now(State.SUSPENDED, str(error))
        await journal.add(WAITS, why=str(error), condition=BALLBAR)
        await self._control.unless_stopped(self._bar.make_ready(within_s=self._suspending.longest_s))
        runner.touched = True
        raise RunInterrupted(
            f"the ball-bar's box was lost and is back ({error.code})", "the test begins again; what was read is kept as evidence"
        ) from error
