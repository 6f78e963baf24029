"""A verification that cannot be stored after the decision: the error says what is in force all the same."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from abbe.models.verification import VerificationFigure
from abbe.service.compensation import correct
from abbe.service.compensation.pushing import PushResult
from abbe.service.errors import StoreError
from abbe.service.sequences.control import Control
from abbe.service.storage.store import Store
from abbe.service.verification.verify import DIAGONALS, VerificationDecision, VerificationFigures

NONE = np.zeros(0)
AFTER = VerificationFigures(
    {name: VerificationFigure(0.004, 0.001, NONE, NONE) for name in DIAGONALS}, VerificationFigure(0.002, 0.001, NONE, NONE)
)
WORDS = {True: "the table is kept and in force: as decided", False: "the table is rolled back: as decided"}


@pytest.mark.parametrize("kept", [True, False])
async def test_the_note_says_what_is_in_force(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept: bool) -> None:
    path = tmp_path / "abbe.sqlite3"
    with Store.open(f"sqlite:///{path}") as store:
        store.campaigns.add(store.machines.add("sim", {}), "verify-after-push-1", {})
        site = SimpleNamespace(name="sim", doc={})
        bench = SimpleNamespace(
            session=SimpleNamespace(controller=None), store=store, site=site, clock=None, attended=True, control=Control()
        )

        class Work(correct._PushQuestions):
            def drift_reasons(self) -> list[str]:
                return []

        class Decided:
            """The push machine, when it has decided; nothing of it fails."""

            def __init__(self, *_: object, **__: object) -> None: ...

            async def bring(self, *_: object) -> PushResult:
                work.after, work.decision, work.verified_as = AFTER, VerificationDecision(kept, "as decided"), "verify-after-push-1"
                return PushResult(1, 1, 1, 7, 0, kept, "as decided", ())

        held = SimpleNamespace(by="anna", approval=lambda clock: None)
        work = Work(cast("Any", bench), cast("Any", SimpleNamespace(precheck=held, level=3)), None, None, AFTER, cast("Any", None))
        monkeypatch.setattr(correct, "Pushing", Decided)
        await correct._push_and_verify(work, cast("Any", None))
        (stored,) = store.verifications.latest()
        assert stored.verdict == ("pass" if kept else "fail")
        with closing(sqlite3.connect(path)) as raw:
            raw.execute("ALTER TABLE verifications RENAME TO away")
        with pytest.raises(StoreError) as told:
            await correct._push_and_verify(work, cast("Any", None))
    assert told.value.__notes__ == [WORDS[kept]]
