"""A measured run: set-up, columns and circumstances of an ``abbe-run/1`` document, parsed once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import PlainValidator

from abbe.models.arrays import F1, F2
from abbe.models.paths import Law
from abbe.service.domain.artefact import ARTEFACT_TEST, MACHINE_PROBE, ArtefactObject
from abbe.service.domain.document import Doc, parsed
from abbe.service.domain.measured import RunTable
from abbe.service.domain.run_file import RUN_FORMAT
from abbe.service.errors import MeasurementFault, StoreError

B1 = NDArray[np.bool_]
SENSORS = ("x", "y", "z", "spindle", "air")
"""Temperature sensors with a column of their own, ``temp_x_C`` .. ``temp_air_C``."""
PLACES = ("x_mm", "y_mm", "z_mm")
PRESSURE = "pressure_air_Pa"
FEATURE = "feature"
"""Column that only a run of an artefact has; its readings are ``deviation_x_mm`` .. ``deviation_z_mm``."""
_TYPED = frozenset(("t_s", *PLACES, "feed_mm_min", "direction", "deviation_mm", "valid"))


@dataclass(frozen=True, kw_only=True, eq=False)
class Columns:
    """Readings of a run, one row each, n rows.

    ``q_mm``: commanded positions, shape (n, 3); ``direction``: +1 or -1; ``deviation_mm``: None for a sealed run; ``valid``: all true if
    the document does not state it (``valid_stated`` False); ``further``: other columns by name, in order.
    """

    t_s: F1
    q_mm: F2
    feed_mm_min: F1
    direction: F1
    deviation_mm: F1 | None
    valid: B1
    valid_stated: bool = True
    further: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    @classmethod
    def from_document(cls, doc: Doc) -> Self:
        """Parse ``columns`` of a run; a column that is null counts as missing."""
        t_s, valid = _floats(doc["t_s"]), doc.get("valid")
        return cls(
            t_s=t_s,
            q_mm=np.column_stack([_floats(doc[name]) for name in PLACES]),
            feed_mm_min=np.full(t_s.size, np.nan) if FEATURE in doc else _floats(doc["feed_mm_min"]),
            direction=np.ones(t_s.size) if FEATURE in doc else _floats(doc["direction"]),
            deviation_mm=None if FEATURE in doc or doc["deviation_mm"] is None else _floats(doc["deviation_mm"]),
            valid=np.ones(t_s.size, dtype=np.bool_) if valid is None else np.asarray(valid).astype(np.bool_),
            valid_stated=valid is not None,
            further={name: _numbers(values) for name, values in doc.items() if name not in _TYPED and values is not None},
        )

    @classmethod
    def concatenated(cls, parts: Sequence[Columns]) -> Columns:
        """The rows of several parts, with the columns that the last part has."""
        last = parts[-1]
        sealed = last.deviation_mm is None
        return replace(
            last,
            t_s=np.concatenate([part.t_s for part in parts]),
            q_mm=np.concatenate([part.q_mm for part in parts]),
            feed_mm_min=np.concatenate([part.feed_mm_min for part in parts]),
            direction=np.concatenate([part.direction for part in parts]),
            deviation_mm=None if sealed else np.concatenate([part.readings_mm for part in parts]),
            valid=np.concatenate([part.valid for part in parts]),
            further={name: np.concatenate([part.further[name] for part in parts]) for name in last.further},
        )

    def __len__(self) -> int:
        """Number of rows."""
        return int(self.t_s.size)

    @property
    def of_artefact(self) -> bool:
        """Whether the readings are points of an artefact."""
        return FEATURE in self.further

    @property
    def readings_mm(self) -> F1:
        """All readings, valid or not, shape (n,).

        Raises
        ------
        MeasurementFault
            The run is sealed.
        """
        if self.deviation_mm is None:
            raise MeasurementFault("the run is sealed: its readings are withheld", "Abbe can only predict this run")
        return self.deviation_mm

    @property
    def temperatures_c(self) -> dict[str, F1]:
        """Temperatures by sensor (`SENSORS`), °C."""
        return {s: _floats(self.further[f"temp_{s}_C"]) for s in SENSORS if f"temp_{s}_C" in self.further}

    @property
    def air_c(self) -> F1:
        """Temperature of the air at each row, or of the artefact, °C; empty if no row has one."""
        found = _floats(self.further["temperature_C"]) if "temperature_C" in self.further else self.temperatures_c.get("air", np.zeros(0))
        return found if np.isfinite(found).any() else np.zeros(0)

    def by_name(self) -> dict[str, NDArray[Any]]:
        """All columns by their names in the format, without those that are sealed or missing."""
        places = {name: self.q_mm[:, k] for k, name in enumerate(PLACES)}
        out: dict[str, NDArray[Any]] = {"t_s": self.t_s, **places}
        out |= {} if self.of_artefact else {"feed_mm_min": self.feed_mm_min, "direction": self.direction}
        out |= {} if self.deviation_mm is None else {"deviation_mm": self.deviation_mm}
        before = {name: v for name, v in self.further.items() if name.startswith("temp_") or name == PRESSURE}
        out |= before | ({"valid": self.valid} if self.valid_stated else {})
        return out | {name: v for name, v in self.further.items() if name not in before}

    def rows(self, chosen: Any) -> Columns:
        """The chosen rows (an index of NumPy: a slice, row numbers or a mask) of every column."""
        return replace(
            self,
            t_s=self.t_s[chosen],
            q_mm=self.q_mm[chosen],
            feed_mm_min=self.feed_mm_min[chosen],
            direction=self.direction[chosen],
            deviation_mm=None if self.deviation_mm is None else self.deviation_mm[chosen],
            valid=self.valid[chosen],
            further={name: values[chosen] for name, values in self.further.items()},
        )

    def equals(self, other: Columns) -> bool:
        """Whether another object has the same columns with the same numbers."""
        mine, theirs = self.by_name(), other.by_name()
        return mine.keys() == theirs.keys() and all(_same(values, theirs[name]) for name, values in mine.items())

    def to_document(self) -> Doc:
        """Plain lists of Python numbers by column; ``deviation_mm`` is null for a sealed run."""
        if self.of_artefact:
            return {name: [None if v != v else v for v in values.tolist()] for name, values in self.by_name().items()}
        out: Doc = {name: values.tolist() for name, values in self.by_name().items()}
        out |= {"direction": self.direction.astype(np.int64).tolist()}
        out |= {"valid": self.valid.astype(np.int64).tolist()} if self.valid_stated else {}
        return out if self.deviation_mm is not None else out | {"deviation_mm": None}


def _floats(values: Any) -> F1:
    return np.asarray(values, dtype=np.float64)


def _numbers(values: Any) -> NDArray[Any]:
    """A column with its type: integers stay integers, text stays text."""
    found = np.asarray(values)
    return found if found.dtype.kind in "iuU" else _floats(values)


def _same(one: NDArray[Any], two: NDArray[Any]) -> bool:
    return np.array_equal(one, two, equal_nan=one.dtype.kind == "f" == two.dtype.kind)


Vector = Annotated[F1, PlainValidator(_floats)]
Matrix = Annotated[F2, PlainValidator(_floats)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Setup:
    """Mounting of an instrument, parsed by `parsed_setup`.

    ``t_set_s``: time of mounting on the campaign's clock; ``tool_mm`` None: the machine's tool; ``axis``: letter of the axis of a helix
    or of a positioning test; ``document``: all keys as stored, also those without a field, for digests and listings.
    """

    setup_id: str
    t_set_s: float | None = None
    tool_mm: Vector | None = None
    axis: str = ""
    document: Doc = field(repr=False)

    def __eq__(self, other: object) -> bool:
        """Whether another set-up has the same values."""
        return isinstance(other, Setup) and self.document == other.document

    def mounted(self, t_set_s: float) -> Self:
        """The same set-up with this time of mounting, s."""
        return replace(self, t_set_s=t_set_s, document=self.document | {"t_set_s": t_set_s})

    def noted(self, **facts: Any) -> Self:
        """The same set-up with these keys added to its document; none of them has a field."""
        return replace(self, document=self.document | facts)

    def named(self, setup_id: str) -> Self:
        """The same set-up under another name."""
        return replace(self, setup_id=setup_id, document=self.document | {"setup_id": setup_id})


@dataclass(frozen=True, kw_only=True, eq=False)
class BarSetup(Setup):
    """Mounting of a ball-bar: the cup's centre, the bar, and the path about it.

    ``turns``: number of turns of a helix; ``plane``, ``span_deg``: plane and covered angle of a circle; ``opens``: side of the pole on
    ``axis``, where the spindle is; ``samples``: number of samples of a reading at standstill, None for a continuous path. ``law``,
    ``even``, ``chord_mm``, ``rate_hz``: further values to repeat the same path.
    """

    centre_mm: Vector
    radius_mm: float
    turns: float | None = None
    plane: str = ""
    span_deg: float = 360.0
    length_calibrated: bool | None = None
    u_length_mm: float | None = None
    opens: Literal[1, -1] | None = None
    under_the_cup: bool = False
    samples: int | None = None
    law: Law | None = None
    even: bool | None = None
    chord_mm: float | None = None
    rate_hz: int | None = None

    @property
    def place_mm(self) -> F1:
        """Position of the set-up: the centre of the sphere."""
        return self.centre_mm


@dataclass(frozen=True, kw_only=True, eq=False)
class LaserSetup(Setup):
    """Mounting of a laser along one line.

    ``diagonal``: letters of the body diagonal; ``face``: plane of a face diagonal; ``order``: order in which a step diagonal moves its
    axes, empty for a plain diagonal, None if not stated; ``increment_mm``: length of a step, by axis; ``overrun_mm``: travel past both
    ends to turn.
    """

    start_mm: Vector | None = None
    end_mm: Vector | None = None
    nominal_beam: Vector | None = None
    diagonal: str = ""
    face: str = ""
    order: str | None = None
    steps: int = 0
    increment_mm: Vector | None = None
    cycles: int = 1
    overrun_mm: float = 0.0

    @property
    def place_mm(self) -> F1:
        """Position for mounting: the start of the line. Raises like `ends_mm`."""
        return self.ends_mm[0]

    @property
    def ends_mm(self) -> tuple[F1, F1]:
        """Start and end, mm.

        Raises
        ------
        ValueError
            The set-up states no start or no end.
        """
        if self.start_mm is None or self.end_mm is None:
            raise ValueError(f"set-up {self.setup_id} does not state start_mm and end_mm")
        return self.start_mm, self.end_mm

    @property
    def span_mm(self) -> F1:
        """Vector from start to end, mm, shape (3,); raises like `ends_mm`."""
        start, end = self.ends_mm
        return end - start


@dataclass(frozen=True, kw_only=True, eq=False)
class ArtefactPose:
    """Pose of an artefact; ``matrix``: columns are the artefact's axes in machine axes, shape (3, 3)."""

    origin_mm: Vector
    matrix: Matrix


@dataclass(frozen=True, kw_only=True, eq=False)
class ArtefactSetup(Setup):
    """Position of an artefact.

    ``source``: instrument that found its points. ``features``, ``cmm``: the campaign's statements (`Run.with_artefact`).
    """

    artefact: str
    source: str
    pose: ArtefactPose
    features: ArtefactObject | None = None
    cmm: Doc = field(default_factory=dict, repr=False)

    @property
    def place_mm(self) -> F1:
        """Axis position of the artefact's zero, mm."""
        return self.pose.origin_mm

    @property
    def by_machine(self) -> bool:
        """Whether the machine's probe found the points; otherwise the machine made the features and a CMM found their points."""
        return self.source == MACHINE_PROBE


AnySetup = BarSetup | LaserSetup | ArtefactSetup


def parsed_setup(test: str, doc: Doc) -> AnySetup:
    """Parse ``setup`` of a run of this test; null counts as missing. Raises ValueError."""
    kind: type[AnySetup] = ArtefactSetup if test == ARTEFACT_TEST else BarSetup if test.startswith("ballbar") else LaserSetup
    return parsed(kind, {key: value for key, value in doc.items() if value is not None} | {"document": doc})


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


@dataclass(frozen=True, kw_only=True)
class RunPart:
    """An interrupted run whose readings belong to the run that resumed its path."""

    run: str
    readings: int


@dataclass(frozen=True, kw_only=True)
class RunTiming:
    """Agreement of the clocks of a ball-bar run (`abbe.service.runs.sample_columns`).

    ``trouble``: their disagreement, empty if they agree; ``counted``: an imported file has no times, and t_s only counts its readings;
    ``pieces``: pieces of a resumed path; ``document``: all figures as stored.
    """

    trouble: str = ""
    counted: bool = False
    pieces: tuple[RunPart, ...] = ()
    document: Doc = field(default_factory=dict, repr=False)

    @classmethod
    def from_document(cls, doc: Doc | None) -> Self:
        """Parse ``timing`` of a run; None counts as empty."""
        known = doc or {}
        pieces = tuple(RunPart(run=str(one["run"]), readings=int(one["readings"])) for one in known.get("pieces", ()))
        return cls(trouble=str(known.get("trouble") or ""), counted=known.get("counted") is True, pieces=pieces, document=known)


@dataclass(frozen=True, kw_only=True)
class RunState:
    """State of a run that is incomplete or has not read enough of its path; ``covered``: share that it has read, None if unknown."""

    status: str
    covered: float | None = None

    @classmethod
    def from_document(cls, doc: Doc) -> Self:
        """Parse ``state`` of a run."""
        return cls(status=str(doc.get("status", "complete")), covered=_number(doc.get("covered")))

    def to_document(self) -> Doc:
        """The value of the key ``state`` in a run's document."""
        return {"status": self.status} | ({} if self.covered is None else {"covered": self.covered})


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One measured sequence (``abbe-run/1``).

    ``machine``: machine object of the format; ``state``: None for a complete run; ``ended_utc``: end of a stored run;
    ``measured_digest``, ``subtracted``: digest of the measured data, and descriptions of what was subtracted from the readings since; empty
    if they are as measured.
    """

    campaign: str
    run_id: str
    test: str
    role: str
    machine: Doc = field(repr=False)
    setup: AnySetup
    columns: Columns = field(repr=False)
    table: RunTable = field(default_factory=RunTable)
    timing: RunTiming = RunTiming()
    state: RunState | None = None
    ended_utc: str = ""
    measured_digest: str = ""
    subtracted: tuple[str, ...] = ()

    @classmethod
    def from_document(cls, doc: Doc) -> Self:
        """Parse an ``abbe-run/1`` document; keys outside the format are not kept.

        Raises
        ------
        StoreError
            A key is missing, or has another type.
        """
        try:
            test = str(doc["test"])
            return cls(
                campaign=str(doc.get("campaign", "")),
                run_id=str(doc["run_id"]),
                test=test,
                role=str(doc["role"]),
                machine=doc.get("machine") or {},
                setup=parsed_setup(test, doc["setup"]),
                columns=Columns.from_document(doc["columns"]),
                table=RunTable.from_document(doc.get("table")),
                timing=RunTiming.from_document(doc.get("timing")),
                state=RunState.from_document(doc["state"]) if doc.get("state") else None,
            )
        except (AttributeError, KeyError, TypeError, ValueError) as err:
            raise StoreError(
                f"run {doc.get('campaign', '')}/{doc.get('run_id', '')}: its document has a missing or invalid field: {err}",
                "Abbe did not write this, or the database is damaged: restore a backup",
            ) from None

    def to_document(self) -> Doc:
        """The ``abbe-run/1`` document."""
        head = {"format": RUN_FORMAT, "campaign": self.campaign, "run_id": self.run_id, "test": self.test, "role": self.role}
        body = {"machine": self.machine, "setup": self.setup.document, "columns": self.columns.to_document()}
        more = {"table": self.table.document, "timing": self.timing.document}
        state = {} if self.state is None else {"state": self.state.to_document()}
        return head | body | {key: value for key, value in more.items() if value} | state

    @property
    def is_bar(self) -> bool:
        """Whether a ball-bar made the readings."""
        return isinstance(self.setup, BarSetup)

    @property
    def is_artefact(self) -> bool:
        """Whether the readings are points of an artefact."""
        return isinstance(self.setup, ArtefactSetup)

    @property
    def instrument(self) -> str:
        """``ballbar``, ``laser`` or ``artefact``."""
        return "ballbar" if self.is_bar else "artefact" if self.is_artefact else "laser"

    @property
    def is_sealed(self) -> bool:
        """Whether the readings are withheld."""
        return self.columns.deviation_mm is None and not self.columns.of_artefact

    @property
    def identifies(self) -> bool:
        """Whether solutions and searches are fitted to this run."""
        return self.role == "identify"

    @property
    def bar(self) -> BarSetup:
        """The set-up of a ball-bar run.

        Raises
        ------
        MeasurementFault
            The run is of a laser or an artefact.
        """
        if not isinstance(self.setup, BarSetup):
            raise MeasurementFault(f"run {self.run_id} was not measured with a ball-bar", "leave it out")
        return self.setup

    @property
    def laser(self) -> LaserSetup:
        """The set-up of a laser run.

        Raises
        ------
        MeasurementFault
            The run is of a ball-bar or an artefact.
        """
        if not isinstance(self.setup, LaserSetup):
            raise MeasurementFault(f"run {self.run_id} was not measured with a laser", "leave it out")
        return self.setup

    @property
    def beam(self) -> F1:
        """Nominal beam of a laser run, unit vector: as stated, else along the tested axis, else from start to end.

        Raises
        ------
        MeasurementFault
            The set-up states no beam, or the run is not of a laser.
        """
        setup = self.laser
        beam = setup.nominal_beam
        if beam is None and setup.start_mm is not None and setup.end_mm is not None:
            beam = setup.span_mm * np.eye(3)["XYZ".index(setup.axis)] if setup.axis else setup.span_mm
        length = np.nan if beam is None else float(np.linalg.norm(beam))
        if beam is None or beam.shape != (3,) or not (np.isfinite(length) and length > 0.0):
            why = f"run {self.run_id}: a laser run needs nominal_beam, or a start_mm that differs from end_mm"
            raise MeasurementFault(why, "correct the run or leave it out")
        return np.asarray(beam / length)

    def with_artefact(self, campaign: Doc) -> Run:
        """Return the run with its artefact and CMM as the campaign's document states them; a run without an artefact stays as it is.

        Raises
        ------
        MeasurementFault
            The campaign has no such artefact, or the artefact lacks a feature of the run.
        """
        setup = self.setup
        if not isinstance(setup, ArtefactSetup):
            return self
        found = (campaign.get("artefacts") or {}).get(setup.artefact)
        if found is None:
            raise MeasurementFault(f"run {self.run_id}: the campaign has no artefact {setup.artefact!r}", "add it under the key artefacts")
        features = ArtefactObject.read(found)
        strange = set(self.columns.further[FEATURE].tolist()) - {f.id for f in features.features}
        if strange:
            why = f"run {self.run_id}: artefact {setup.artefact} has no feature {min(strange)!r}"
            raise MeasurementFault(why, "correct the column 'feature' or the artefact's list")
        return replace(self, setup=replace(setup, features=features, cmm=(campaign.get("instruments") or {}).get("cmm") or {}))

    def with_readings(self, deviation_mm: F1) -> Run:
        """The run with other readings, mm, shape (n,)."""
        return replace(self, columns=replace(self.columns, deviation_mm=deviation_mm))

    def mounted(self, t_set_s: float) -> Run:
        """The run with this mounting time of its set-up, s."""
        return replace(self, setup=self.setup.mounted(t_set_s))
