"""The protocol with one of its protections taken away: the sweep has to see what that costs (test of the test)."""

from __future__ import annotations

from dataclasses import dataclass

from tests.push.loading import Edits
from tests.push.world import Case


@dataclass(frozen=True, slots=True)
class Variant:
    """``must``: invariants of which at least these are violated."""

    name: str
    edits: Edits
    case: Case
    must: tuple[str, ...]


VARIANTS = (
    Variant("no compare-and-swap in the controller", (), Case("no swap", level=3, compares=False), ("I1", "I3")),
    Variant(
        "no read-back",
        (
            ("operations", "isinstance(outcome, Done) and outcome.value == op.data", "isinstance(outcome, Done)"),
            (
                "operations",
                "if known.image != image.data or (image.semantic_digest and known.decoded_digest != image.semantic_digest):",
                "if False:",
            ),
            ("operations", "or truth.crc[image.bank] != image.crc:", "or False:"),
            ("machine", "if not why and truth.crc[f.target] != f.crc:", "if False:"),
            ("machine", "expect_crc=f.crc, expect_gen", "expect_crc=truth.crc[f.target], expect_gen"),
        ),
        Case("no read-back"),
        ("I1",),
    ),
    Variant(
        "written in place",
        (("machine", '"target": 1 - active}', '"target": active}'),),
        Case("in place", one_bank=True),
        ("I1", "I2"),
    ),
)
