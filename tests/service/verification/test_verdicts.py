"""Keep or go back, pass or fail: decisions about measured figures with their uncertainty."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from abbe.models.verification import VerificationFigure
from abbe.service.config import load_machine
from abbe.service.errors import TableRefused
from abbe.service.verification.verify import VerificationFigures, check_before, decide, judge, judged, overall
from tests.run_documents import runs_of
from tests.service.backup.conftest import new_machine_file
from tests.service.verification.test_coverage import verification

NONE = np.zeros(0)


AIR = (20.0, 20.4)


def figures(
    ppp: float,
    others: float = 5.0,
    helix: float | None = 5.0,
    u: float = 0.5,
    u_helix: float = 0.5,
    air=AIR,
    crc=(7,),
    reversal: float | None = None,
) -> VerificationFigures:
    def figure(um: float, u: float = u) -> VerificationFigure:
        return VerificationFigure(um * 1e-3, u * 1e-3, NONE, NONE)

    diagonals = {"ppp": figure(ppp)} | {k: figure(others) for k in ("npp", "pnp", "ppn")}
    reversals = {} if reversal is None else {"ppp": figure(reversal), "npp": figure(0.0)}
    return VerificationFigures(diagonals, None if helix is None else figure(helix, u_helix), air, frozenset(crc), reversals=reversals)


@pytest.mark.parametrize(
    ("before", "after", "keep", "why"),
    [
        (figures(40), figures(10), True, "40.0 → 10.0"),
        (figures(40), figures(39), False, "no improvement beyond its uncertainty"),
        (figures(40), figures(60), False, "no improvement"),
        (figures(20), figures(10, others=8.9), False, "diagonal npp got worse"),
        (figures(60, others=4), figures(10, others=9), True, "60.0 → 10.0"),  # 5 um is a small part of what the worst one was
        (figures(40), figures(10, helix=7.5), False, "helix got worse"),
        (figures(40, helix=2.0), figures(10, helix=6.9), False, "helix got worse"),
        (figures(40, reversal=2.0), figures(10, reversal=3.0), True, "40.0 → 10.0"),
        (figures(40, reversal=2.0), figures(10, reversal=8.0), False, "mean reversal of ppp got worse"),
        (figures(40, reversal=2.0), figures(10, reversal=float("nan")), False, "not a number"),
        (figures(40), figures(10, helix=None), False, "only one of the two verifications has a helix"),
        (figures(40, helix=None), figures(10), False, "only one of the two verifications has a helix"),
        (figures(40, helix=None), figures(10, helix=None), True, "40.0 → 10.0"),
        (figures(40, u=20), figures(10, u=20), False, "no improvement beyond its uncertainty"),
        (figures(40), figures(10, u_helix=20), False, "cannot tell whether something got worse: the helix is uncertain by 40.0 µm"),
        (figures(40), figures(float("nan")), False, "not a number"),
        (figures(40), figures(10, helix=float("nan")), False, "not a number"),
        (figures(40), figures(10, u_helix=float("inf")), False, "not a number"),
        (figures(float("nan")), figures(10), False, "not a number"),
        (figures(40), figures(10, air=(20.9, 21.1)), False, "20.0 to 21.1 °C"),
        (figures(40), figures(10, air=(20.8, 20.9)), True, "40.0 → 10.0"),
        (figures(40), figures(10, air=None), False, "the air temperature is not known"),
        (figures(40), figures(10, crc=(7, 8)), False, "measured with table 00000007, 00000008, but table 00000007 was brought into force"),
        (figures(40), figures(10, crc=(None,)), False, "unrecorded"),
        (figures(40), figures(10, crc=()), False, "unrecorded"),
    ],
)
def test_keep_only_what_is_better_and_nowhere_worse(before, after, keep, why):
    decision = decide(before, after, 7)
    assert decision.keep is keep
    assert why in decision.text


@pytest.mark.parametrize(
    ("value", "u", "verdict"), [(8.9, 0.5, "pass"), (9.5, 0.5, "cannot tell"), (10.9, 0.5, "cannot tell"), (11.1, 0.5, "fail")]
)
def test_a_verdict_keeps_its_distance_from_the_limit(value, u, verdict):
    assert judge(value, u, 10.0) == verdict


def test_the_worst_verdict_counts_and_nothing_judged_is_no_pass():
    assert overall(["pass", "cannot tell"]) == "cannot tell"
    assert overall(["cannot tell", "fail"]) == "fail"
    assert overall([]) == "cannot tell"


@pytest.mark.parametrize(("before", "why"), [(figures(float("nan")), "not a number"), (figures(40, air=None), "no air temperature")])
def test_a_verification_that_nothing_compares_with_is_refused_before_anything_is_written(before, why):
    with pytest.raises(TableRefused, match=why):
        check_before(before)
    check_before(figures(40))


def test_a_check_measures_the_reversal_and_judges_it_only_with_a_limit(tmp_path: Path) -> None:
    config = load_machine(new_machine_file(tmp_path)).machine
    limited = config.model_copy(update={"verify": config.verify.model_copy(update={"reversal_um": 4.0})})
    runs = verification()
    for run in runs[:4]:  # eight micrometres are lost on the way back; the means, and so the diagonals, stay as they are
        there = run["columns"]
        there["deviation_mm"] = [v - (0.008 if way < 0 else 0.0) for v, way in zip(there["deviation_mm"], there["direction"], strict=True)]
    when = datetime(2026, 11, 29, tzinfo=UTC)
    open_, strict = (judged(one, runs_of(runs), "june", when, 60.0) for one in (config, limited))
    assert open_.values["reversal_um"] == pytest.approx(8.0, abs=2 * open_.uncertainties["reversal_um"])
    assert "reversal_um" not in open_.limits
    assert open_.text.endswith("worst mean reversal 8.0 µm")
    assert strict.verdict == "fail"
    assert strict.text.endswith("worst mean reversal 8.0 µm (limit 4)")
