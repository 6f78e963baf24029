"""A table as somebody proposes it, with everything that it was made from: plain values that may be wrong in any way."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Column:
    """Correction of one axis over the travel of one axis.

    ``left_mm``: the machine's error in this column with the table in force, as it was measured: a correction against it makes it smaller.
    ``reverse_mm``: corrections when coming from the other side, empty without; ``reversal_mm``: measured mean difference, reverse
    minus forward.
    """

    moved: str
    corrected: str
    position_mm: tuple[float, ...]
    correction_mm: tuple[float, ...]
    left_mm: tuple[float, ...] = ()
    reverse_mm: tuple[float, ...] = ()
    reversal_mm: float = 0.0


@dataclass(frozen=True, slots=True)
class TableEvidence:
    """What the table was computed from. Lengths mm, ``machine_mark``: see `CandidateContext`.

    ``ended_s``, ``last_s``: end of the oldest and of the newest run, seconds of the service's UTC; without the second there is one end.
    """

    run_count: int
    ended_s: float
    temperature_c: tuple[float, float]
    drift_mm: float
    u_mm: float
    before_mm: float
    after_mm: float
    machine_mark: str
    calibrated_until_s: tuple[float, ...]
    last_s: float | None = None


@dataclass(frozen=True, slots=True)
class EvidenceSeal:
    """Who vouches for the table: role and SHA-256 of what was signed; empty without a signature."""

    role: str = ""
    digest: str = ""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A proposed table. ``base_crc``: of the table that was in force while it was measured, which is the one it may replace."""

    machine: str
    map_version: int
    lsb_nm: int
    length_unit: str
    columns: tuple[Column, ...]
    base_crc: int
    evidence: TableEvidence
    digest: str
    seal: EvidenceSeal = field(default_factory=EvidenceSeal)


@dataclass(frozen=True, slots=True)
class CandidateContext:
    """What the candidate is held against: this machine, its controller, the table in force, and now.

    Parameters
    ----------
    machine, machine_mark : str
        Name; and a mark that changes with every reboot, crash alarm and maintenance, after which old measurements do not count.
    map_version, lsb_nm, bank_registers : int
        Of the controller.
    travel_mm : dict
        Axis -> (lowest, highest) position.
    grid_mm : dict
        Axis -> the controller's grid, where it prescribes one.
    active_crc, active : int, dict
        Table in force: its CRC; (moved, corrected) -> corrections on the candidate's grid, empty for no correction.
    month_ago : dict
        The same for the table of 30 days ago.
    now_s : float
        UTC.
    attended : bool
        A person who may approve is at the machine.
    last_push_s : float
        When something was pushed last without a person; minus infinity for never.
    """

    machine: str
    machine_mark: str
    map_version: int
    lsb_nm: int
    bank_registers: int
    travel_mm: dict[str, tuple[float, float]]
    grid_mm: dict[str, tuple[float, ...]]
    active_crc: int
    active: dict[tuple[str, str], tuple[float, ...]]
    month_ago: dict[tuple[str, str], tuple[float, ...]]
    now_s: float
    attended: bool = True
    last_push_s: float = float("-inf")
