"""States of a push, their transitions, and the journal entry of a transition. An entry is on disk before the operation that it permits."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from abbe.service.domain.document import Doc


class PushState(StrEnum):
    """State of a push; the value is the text in the journal."""

    SNAPSHOT = "SNAPSHOT"
    """The table in force was read twice; the entry holds it in full."""
    REJECTED = "REJECTED"
    """Validation failed or approval was refused; nothing was written."""
    VALIDATED = "VALIDATED"
    APPROVED = "APPROVED"
    LEASED = "LEASED"
    STAGING = "STAGING"
    """Permits writing the inactive bank."""
    STAGED = "STAGED"
    """The inactive bank was read back twice and is sealed with the expected CRC."""
    ACTIVATING = "ACTIVATING"
    """Permits exactly one activation of the new table."""
    PROBATION = "PROBATION"
    """The new table is active and was read back again; permits the sign probe."""
    PROBED = "PROBED"
    """Sign, axis and unit were proved physically; permits the verification."""
    VERIFIED = "VERIFIED"
    KEEP = "KEEP"
    ROLLBACK = "ROLLBACK"
    """The new table must not stay; permits preparing the rollback."""
    RESTAGING = "RESTAGING"
    """Permits writing the old table into the inactive bank."""
    ACTIVATING_BACK = "ACTIVATING_BACK"
    """Permits exactly one activation of the old table."""
    ROLLBACK_PENDING = "ROLLBACK_PENDING"
    """The rollback is blocked (interlock, link, lease) and runs as soon as possible, before anything else."""
    ROLLED_BACK = "ROLLED_BACK"
    ABORTED = "ABORTED"
    """The new table was never in force."""
    OPERATOR = "OPERATOR"
    """The controller holds a table unknown to the journal: nothing happens until a person has looked."""
    ACCEPTED = "ACCEPTED"
    """A person has looked and vouches for the table in force."""


S = PushState

TERMINAL = frozenset({S.REJECTED, S.ABORTED, S.KEEP, S.ROLLED_BACK, S.OPERATOR, S.ACCEPTED})
BEFORE_ACTIVATION = frozenset({S.SNAPSHOT, S.VALIDATED, S.APPROVED, S.LEASED, S.STAGING, S.STAGED})
GOING_BACK = frozenset({S.ROLLBACK, S.RESTAGING, S.ACTIVATING_BACK, S.ROLLBACK_PENDING})

FOLLOWS: dict[PushState | None, frozenset[PushState]] = {
    None: frozenset({S.SNAPSHOT}),
    S.SNAPSHOT: frozenset({S.VALIDATED, S.REJECTED, S.ABORTED}),
    S.VALIDATED: frozenset({S.APPROVED, S.REJECTED, S.ABORTED}),
    S.APPROVED: frozenset({S.LEASED, S.ABORTED}),
    S.LEASED: frozenset({S.STAGING, S.ABORTED}),
    S.STAGING: frozenset({S.STAGED, S.ABORTED}),
    S.STAGED: frozenset({S.ACTIVATING, S.ABORTED}),
    S.ACTIVATING: frozenset({S.PROBATION, S.ROLLBACK, S.ABORTED, S.OPERATOR}),
    S.PROBATION: frozenset({S.PROBED, S.ROLLBACK, S.OPERATOR}),
    S.PROBED: frozenset({S.VERIFIED, S.ROLLBACK, S.OPERATOR}),
    S.VERIFIED: frozenset({S.KEEP, S.ROLLBACK, S.OPERATOR}),
    S.ROLLBACK: frozenset({S.RESTAGING, S.ACTIVATING_BACK, S.ROLLED_BACK, S.ROLLBACK_PENDING, S.OPERATOR}),
    S.RESTAGING: frozenset({S.ACTIVATING_BACK, S.ROLLBACK, S.ROLLED_BACK, S.ROLLBACK_PENDING, S.OPERATOR}),
    S.ACTIVATING_BACK: frozenset({S.ROLLED_BACK, S.ROLLBACK, S.ROLLBACK_PENDING, S.OPERATOR}),
    S.ROLLBACK_PENDING: frozenset({S.ROLLBACK, S.ROLLED_BACK, S.OPERATOR}),
    S.OPERATOR: frozenset({S.ACCEPTED}),
    S.REJECTED: frozenset({S.ACCEPTED}),
    S.ABORTED: frozenset({S.ACCEPTED}),
    S.KEEP: frozenset({S.ACCEPTED}),
    S.ROLLED_BACK: frozenset({S.ACCEPTED}),
    S.ACCEPTED: frozenset({S.ACCEPTED}),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class PushTransition:
    """One transition of one push, chained by ``prev`` to the entry before it in the same journal.

    ``number``: given by the database; ``machine``: name of the journal (`abbe.service.storage.repositories.results.chain_of`); ``push``:
    number of the push in it; ``seq``: number of the entry in its push, from 0; ``utc``: time, for people; ``prev``, ``digest``: SHA-256
    of the entry before (of any push of the machine) and of this one.
    """

    number: int = 0
    machine: str
    push: int
    seq: int
    state: PushState
    utc: str
    prev: str
    digest: str


@dataclass(frozen=True, slots=True, kw_only=True)
class PushEntry(PushTransition):
    """A transition and the facts that its state brings. Never changed after writing; tables are hexadecimal images."""

    doc: Doc
