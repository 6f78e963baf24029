"""Where a proposal stands is answered once: the list and the detail say the same, and a changed row hides no other."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from abbe.service.compensation.proposal_decisions import approve, proposal_status, reject
from abbe.service.compensation.proposal_doc import load
from abbe.service.errors import NotStored, TableRefused, Unusable
from abbe.service.queries.reader import Reader
from abbe.service.queries.tables import ProposalSummary, difference, proposal, proposals
from tests.service.web.api_bench import Plant


def test_list_detail_and_rule_agree(reader: Reader) -> None:
    found, after = proposals(reader, None, None, 50)
    assert after is None
    assert {one.number: one.state for one in found}.items() >= {1: "refused", 5: "changed"}.items()
    for one in found:
        if one.state == "changed":
            continue
        detail = proposal(reader, one.number)
        assert [getattr(detail, name.name) for name in fields(ProposalSummary)] == [getattr(one, name.name) for name in fields(one)]
        now = proposal_status(reader.store, one.number, load(reader.store, one.number), reader.now_s)
        assert (one.state, one.why) == (now.word, now.text)


def test_a_changed_row_says_so_and_promises_nothing(reader: Reader) -> None:
    changed = next(one for one in proposals(reader, None, None, 50)[0] if one.number == 5)
    assert (changed.campaign, changed.by, changed.predicted_rms_um) == ("", "", None)
    with pytest.raises(Unusable, match="was changed after it was stored"):
        proposal(reader, 5)
    with pytest.raises(NotStored, match="there is no proposal 77"):
        proposal(reader, 77)


def test_a_decision_moves_the_state_once(reader: Reader, plant: Plant) -> None:
    row = plant.store.proposals.get(plant.approvable[0])
    number = plant.store.proposals.add(row.machine, row.solution_id, row.doc, row.digest)
    approve(plant.store, number, "anna", 1.0, plant.clock, "user:anna")
    found = proposal(reader, number)
    assert (found.state, found.waits, [one.name for one in found.approvals]) == ("approved", True, ["anna"])
    reject(plant.store, number, "kim", "too warm", plant.clock, "user:kim")
    found = proposal(reader, number)
    assert (found.state, found.waits, [one.reason for one in found.rejections]) == ("rejected", False, ["too warm"])
    with pytest.raises(TableRefused, match="is rejected: by kim: too warm"):
        approve(plant.store, number, "anna", 1.0, plant.clock, "user:anna")


def test_the_difference_to_the_table_in_force_and_to_another(reader: Reader) -> None:
    to_active = difference(reader, 2)
    assert len(to_active.tables) == 9
    assert np.max(np.abs(to_active.tables[0].u_um)) > 0.0
    assert {one.largest_change_um for one in difference(reader, 2, 3).tables} == {0.0}
