"""A proposal of tables as a plain document, and back: everything that is needed to judge it and to push it, and nothing else."""

from __future__ import annotations

import hashlib
import math
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from abbe.drivers.tables import encode
from abbe.models.arrays import F2
from abbe.models.compensation.tables import NineTables, Predicted
from abbe.models.machine import AXES
from abbe.service.errors import StoreError
from abbe.service.push.approval import approval_digest
from abbe.service.push.candidate import Candidate, Column, EvidenceSeal, TableEvidence
from abbe.service.push.entries import Doc, canonical
from abbe.service.push.limits import PushLimits
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import table_image, tables_from_image

FORMAT = "abbe-proposal/1"


@dataclass(frozen=True, slots=True)
class BaseMark:
    """The table in force when it was proposed, and the controller's generation and boot id then."""

    image: bytes
    bank: int
    gen: int
    boot: int


@dataclass(frozen=True, slots=True)
class Proposed:
    """Tables that somebody proposed.

    Parameters
    ----------
    machine : dict
        The machine object (run-format.md 1).
    campaign, solution_id : str, int
        What the tables follow from.
    candidate : Candidate
        The absolute tables in whole units of the controller (mm), what they change, evidence, digest.
    u_mm : tuple of three arrays
        Standard uncertainty of every entry, as in `NineTables`.
    base : BaseMark
        On which table, in which state of the controller.
    image_id : int
        Number inside the image: an approval binds its bytes.
    limits : PushLimits
        Under which it was checked.
    two_people : bool
        Somebody else has to approve it.
    by, utc : str
        Who proposed it (account), when.
    reasons : tuple of str
        What spoke against it then.
    not_for_tables : tuple of str
        Known effects that no table takes out.
    """

    machine: Doc
    campaign: str
    solution_id: int
    candidate: Candidate
    u_mm: tuple[F2, F2, F2]
    base: BaseMark
    image_id: int
    limits: PushLimits
    two_people: bool
    by: str
    utc: str
    reasons: tuple[str, ...]
    not_for_tables: tuple[str, ...]

    @property
    def tables(self) -> NineTables:
        """The absolute tables, exactly as they were proposed."""
        columns = {(c.moved, c.corrected): c for c in self.candidate.columns}
        x, y, z = (np.array(columns[a, "X"].position_mm) for a in AXES)
        cx, cy, cz = (np.column_stack([columns[a, i].correction_mm for i in AXES]) for a in AXES)
        return NineTables((x, y, z), (cx, cy, cz), self.u_mm)

    @property
    def base_tables(self) -> NineTables | None:
        """The tables in force when it was proposed; None for no correction."""
        return tables_from_image(self.base.image)

    @property
    def predicted(self) -> Predicted:
        """What the model promises."""
        e = self.candidate.evidence
        return Predicted(e.before_mm, e.after_mm, e.u_mm)

    @property
    def image(self) -> bytes:
        """The bytes that are to be pushed."""
        return encode(table_image(self.tables, self.candidate.lsb_nm, self.image_id))

    @property
    def valid_until_s(self) -> float:
        """When the measurement becomes too old, UTC."""
        return self.candidate.evidence.ended_s + self.limits.age_h * 3600.0

    def binding(self, expiry: str) -> str:
        """What an approval until ``expiry`` binds: exactly this table on exactly this base, for this machine, under these limits."""
        known = {"image": self.image.hex(), "base_image": self.base.image.hex(), "machine": self.candidate.machine}
        return approval_digest(known | {"limits": self.limits.digest()}, expiry)


def digest_of_doc(doc: Doc) -> str:
    """SHA-256 of a proposal's document."""
    return hashlib.sha256(canonical(doc)).hexdigest()


def doc_of(proposed: Proposed) -> Doc:
    """The document; what is no finite number is written as text."""
    doc = {
        "format": FORMAT,
        "machine": proposed.machine,
        "campaign": proposed.campaign,
        "solution": proposed.solution_id,
        "candidate": asdict(proposed.candidate),
        "u_mm": [u.tolist() for u in proposed.u_mm],
        "base": asdict(proposed.base) | {"image": proposed.base.image.hex()},
        "image_id": proposed.image_id,
        "limits": asdict(proposed.limits),
        "two_people": proposed.two_people,
        "by": proposed.by,
        "utc": proposed.utc,
        "reasons": list(proposed.reasons),
        "not_for_tables": list(proposed.not_for_tables),
    }
    plain = _plain(doc)
    assert isinstance(plain, dict)
    return plain


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def proposed_from(doc: Doc) -> Proposed:
    """Read a document that `doc_of` wrote; KeyError, TypeError or ValueError where it is none."""
    x, y, z = (np.array(u, dtype=np.float64) for u in doc["u_mm"])
    b = doc["base"]
    limits = {f.name: doc["limits"][f.name] for f in fields(PushLimits)}
    low, high = limits["temperature_c"]
    return Proposed(
        dict(doc["machine"]), str(doc["campaign"]), int(doc["solution"]), _candidate(doc["candidate"]), (x, y, z),
        BaseMark(bytes.fromhex(b["image"]), int(b["bank"]), int(b["gen"]), int(b["boot"])), int(doc["image_id"]),
        PushLimits(**(limits | {"temperature_c": (low, high)})), bool(doc["two_people"]), str(doc["by"]), str(doc["utc"]),
        tuple(doc["reasons"]), tuple(doc["not_for_tables"]),
    )  # fmt: skip


def _column(doc: Doc) -> Column:
    def curve(key: str) -> tuple[float, ...]:
        return tuple(float(v) for v in doc[key])

    return Column(
        str(doc["moved"]), str(doc["corrected"]), curve("position_mm"), curve("correction_mm"), curve("left_mm"), curve("reverse_mm"),
        float(doc["reversal_mm"]),
    )  # fmt: skip


def _candidate(doc: Doc) -> Candidate:
    columns = tuple(_column(c) for c in doc["columns"])
    e = doc["evidence"]
    low, high = e["temperature_c"]
    evidence = TableEvidence(
        int(e["run_count"]), float(e["ended_s"]), (float(low), float(high)), float(e["drift_mm"]), float(e["u_mm"]), float(e["before_mm"]),
        float(e["after_mm"]), str(e["machine_mark"]), tuple(float(s) for s in e["calibrated_until_s"]),
        None if e.get("last_s") is None else float(e["last_s"]),
    )  # fmt: skip
    head = (doc["machine"], doc["map_version"], doc["lsb_nm"], doc["length_unit"])
    return Candidate(*head, columns, doc["base_crc"], evidence, doc["digest"], EvidenceSeal(**doc["seal"]))


def load(store: Store, number: int) -> Proposed:
    """Read a proposal from the store.

    Raises
    ------
    StoreError
        There is none of this number, or its row is not what was stored.
    """
    record = store.proposals.get(number)
    try:
        sound = digest_of_doc(record.doc) == record.digest
        proposed = proposed_from(record.doc) if sound else None
    except (KeyError, TypeError, ValueError):
        proposed = None
    if proposed is None or (record.machine, record.solution_id) != (proposed.candidate.machine, proposed.solution_id):
        raise StoreError(f"proposal {number} in {store.url} was changed after it was stored: its content is not that of its digest",
                         "propose again; nothing was written to the controller")  # fmt: skip
    return proposed
