"""Lost motion of the drives: the play operator, whose output depends on where the axis came from."""

import numpy as np

from abbe.simulators.arrays import F


class Play:
    """Three independent play operators with memory.

    An axis with lost motion B, moving in direction s, stands at drive position - s B/2; after a reversal it rests until the drive
    has taken up the whole of B.
    """

    def __init__(self, backlash_mm: F, start_mm: F) -> None:
        self._half = [0.5 * float(b) for b in backlash_mm]
        # A machine that homed towards its positive ends last moved in + direction.
        self.position_mm: F = start_mm - 0.5 * backlash_mm

    def run(self, drive_mm: F) -> F:
        """Follow the drives through n successive positions: (n, 3) gives the axis positions (n, 3)."""
        out = np.empty_like(drive_mm)
        for axis in range(3):
            out[:, axis] = self._run_axis(drive_mm[:, axis], self._half[axis], float(self.position_mm[axis]))
        self.position_mm = out[-1].copy()
        return out

    @staticmethod
    def _run_axis(drive_mm: F, half_mm: float, start_mm: float) -> F | float:
        """One axis; a drive that stays within the play leaves the axis where it is."""
        if float(drive_mm.max()) - half_mm <= start_mm <= float(drive_mm.min()) + half_mm:
            return start_mm
        position = start_mm
        track = []
        for drive in drive_mm.tolist():
            if position < drive - half_mm:
                position = drive - half_mm
            elif position > drive + half_mm:
                position = drive + half_mm
            track.append(position)
        return np.array(track)
