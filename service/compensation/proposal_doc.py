"""A proposal of tables as a JSON document: everything that is needed to judge it and to push it."""

from __future__ import annotations

import hashlib
import math
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field

from abbe.drivers.tables import encode
from abbe.models.arrays import F2
from abbe.models.compensation.tables import NineTables, Predicted
from abbe.models.machine import AXES
from abbe.service.domain.document import Doc, canonical, parsed
from abbe.service.errors import StoreError
from abbe.service.push.journal import approval_digest
from abbe.service.push.validate import Candidate, PushLimits
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import table_image, tables_from_image

FORMAT = "abbe-proposal/1"


@dataclass(frozen=True, slots=True)
class BaseMark:
    """The table in force when the proposal was made, with the controller's generation and boot id."""

    image: Annotated[bytes, BeforeValidator(bytes.fromhex)]
    bank: int
    gen: int
    boot: int


def _arrays(lists: object) -> tuple[F2, ...]:
    return tuple(np.array(one, dtype=np.float64) for one in lists) if isinstance(lists, list | tuple) else ()


@dataclass(frozen=True, slots=True)
class Proposed:
    """Proposed tables.

    Parameters
    ----------
    machine : dict
        The ``machine`` object of the exchange format (docs/schemas/machine.schema.json).
    campaign, solution_id : str, int
        Source of the tables.
    candidate : Candidate
        The absolute tables, mm, rounded to whole units of the controller, with residuals, evidence and digest.
    u_mm : tuple of three arrays
        Standard uncertainty of every entry, as in `NineTables`.
    image_id : int
        Number inside the image. It stays the same because an approval binds the bytes of the image.
    limits : PushLimits
        Limits of the check that gave ``reasons``.
    two_people : bool
        A second person has to approve it.
    by, utc : str
        Account of the proposer, and time.
    reasons : tuple of str
        Reasons against the proposal when it was made.
    not_for_tables : tuple of str
        Known effects that no table corrects.
    holds_at : str
        Temperature of the scales at which the tables hold; empty in proposals of earlier versions.
    """

    __pydantic_config__ = ConfigDict(arbitrary_types_allowed=True)
    machine: Doc
    campaign: str
    solution_id: Annotated[int, Field(alias="solution")]
    candidate: Candidate
    u_mm: Annotated[tuple[F2, F2, F2], BeforeValidator(_arrays)]
    base: BaseMark
    image_id: int
    limits: PushLimits
    two_people: bool
    by: str
    utc: str
    reasons: tuple[str, ...]
    not_for_tables: tuple[str, ...]
    holds_at: str = ""

    @property
    def tables(self) -> NineTables:
        """The absolute tables, exactly as they were proposed."""
        columns = {(c.moved, c.corrected): c for c in self.candidate.columns}
        x, y, z = (np.array(columns[a, "X"].position_mm) for a in AXES)
        cx, cy, cz = (np.column_stack([columns[a, i].correction_mm for i in AXES]) for a in AXES)
        return NineTables((x, y, z), (cx, cy, cz), self.u_mm)

    @property
    def base_tables(self) -> NineTables | None:
        """The tables in force when the proposal was made; None for no correction."""
        return tables_from_image(self.base.image)

    @property
    def predicted(self) -> Predicted:
        """The model's prediction: rms without and with the tables, and its uncertainty."""
        e = self.candidate.evidence
        return Predicted(e.before_mm, e.after_mm, e.u_mm)

    @property
    def image(self) -> bytes:
        """The bytes to be pushed."""
        return encode(table_image(self.tables, self.candidate.lsb_nm, self.image_id))

    @property
    def valid_until_s(self) -> float:
        """Time at which the measurement becomes too old, seconds UTC."""
        return self.candidate.evidence.ended_s + self.limits.age_h * 3600.0

    def binding(self, expiry: str) -> str:
        """Digest of what an approval until ``expiry`` permits: this table on this base, for this machine, under these limits."""
        machine, limits = self.candidate.machine, self.limits.digest()
        return approval_digest(self.image, base_image=self.base.image, machine=machine, limits=limits, expiry=expiry)


def digest_of_doc(doc: Doc) -> str:
    """SHA-256 of a proposal's document."""
    return hashlib.sha256(canonical(doc)).hexdigest()


def doc_of(proposed: Proposed) -> Doc:
    """The document of a proposal; non-finite numbers are written as text."""
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
        "holds_at": proposed.holds_at,
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
    """Read a document that `doc_of` wrote; raises ValueError for any other document."""
    return parsed(Proposed, doc)


def load(store: Store, number: int) -> Proposed:
    """Read a proposal from the store.

    Raises
    ------
    StoreError
        There is no such proposal, or its row was changed.
    """
    record = store.proposals.get(number)
    try:
        sound = digest_of_doc(record.doc) == record.digest
        proposed = proposed_from(record.doc) if sound else None
    except (TypeError, ValueError):
        proposed = None
    if proposed is None or (record.machine, record.solution_id) != (proposed.candidate.machine, proposed.solution_id):
        raise StoreError(f"proposal {number} in {store.url} was changed after it was stored: its content does not match its digest",
                         "propose again; nothing was written to the controller")  # fmt: skip
    return proposed
