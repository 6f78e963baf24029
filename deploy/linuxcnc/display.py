#!/usr/bin/python3
"""An operator without a screen: it releases the e-stop, switches the machine on, references all axes, then waits for TERM.

``$ABBE_READY`` names a file that exists while the machine is referenced. With ``$ABBE_OPERATOR=absent`` this operator does nothing.
"""

import os
import signal
import sys
from pathlib import Path

import linuxcnc

PATIENCE_S = 20


def reference(status, command) -> None:
    """Bring the control from its start to referenced axes."""
    _until(status, lambda: status.joints == 3)
    _until(status, lambda: status.task_state != linuxcnc.STATE_ESTOP, lambda: command.state(linuxcnc.STATE_ESTOP_RESET))
    _until(status, lambda: status.task_state == linuxcnc.STATE_ON, lambda: command.state(linuxcnc.STATE_ON))
    command.mode(linuxcnc.MODE_MANUAL)
    command.wait_complete()
    command.teleop_enable(0)
    command.wait_complete()
    command.home(-1)
    _until(status, lambda: all(status.homed[:3]))


def _until(status, true, ask=None) -> None:
    """Wait until ``true()``; repeat the request ``ask`` now and then, because the control drops requests that come before it is ready."""
    for turn in range(PATIENCE_S * 100):
        status.poll()
        if true():
            return
        if ask and turn % 10 == 0:
            ask()
        signal.sigtimedwait([], 0.01)
    sys.exit("the control did not execute the command")


def main() -> None:
    """Reference the axes, report it, wait."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    ready = Path(os.environ.get("ABBE_READY", "ready"))
    try:
        if os.environ.get("ABBE_OPERATOR") != "absent":
            reference(linuxcnc.stat(), linuxcnc.command())
        ready.touch()
        while True:
            signal.pause()
    finally:
        ready.unlink(missing_ok=True)


if __name__ == "__main__":
    main()
