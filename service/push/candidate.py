"""A proposed table with its evidence: plain values, not yet checked."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Column:
    """Correction of one axis over the travel of one axis.

    ``left_mm``: the machine's measured error in this column with the table in force; a correction of opposite sign reduces it.
    ``reverse_mm``: corrections for the reverse approach, or empty; ``reversal_mm``: measured mean difference, reverse minus forward.
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
    """What the table was computed from. Lengths mm; ``machine_mark``: see `CandidateContext`.

    ``ended_s``, ``last_s``: end of the oldest and of the newest run, seconds UTC by the service's clock; ``last_s`` None: the same.
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
    """Who vouches for the table: role, and SHA-256 of the signed content; empty without a signature."""

    role: str = ""
    digest: str = ""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A proposed table. ``base_crc``: CRC of the table in force during the measurement, the only one that it may replace."""

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
    """What a candidate is checked against: this machine, its controller, the table in force, the time.

    Parameters
    ----------
    machine, machine_mark : str
        Name; mark that changes with every reboot, crash alarm and maintenance, which invalidate older measurements.
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
        Seconds UTC.
    attended : bool
        A person who may approve is at the machine.
    last_push_s : float
        Time of the last unattended push; minus infinity for never.
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
