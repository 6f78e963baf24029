"""What a verification has to be so that a new one can be compared with it: this machine, since its last start, after it was identified."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from abbe.service.compensation.proposals import check_before_runs
from abbe.service.domain.run import Run
from abbe.service.errors import TableRefused
from abbe.service.push.validate import PushLimits
from tests.run_documents import run_of

DOC = {"name": "mill"}
SITE: Any = SimpleNamespace(doc=DOC, limits=PushLimits(), temperature_c=(18.0, 24.0))
BASE: Any = SimpleNamespace(status=SimpleNamespace(boot_id=7))
NOON_S = 1_795_348_800.0  # 2026-11-22 12:00 UTC


def run(**change: Any) -> Run:
    good = {
        "run_id": "ppp", "machine": DOC, "table": {"boot_id": 7}, "columns": {"temp_air_C": [20.0, 20.5]},
    }  # fmt: skip
    ended = change.pop("ended_utc", "2026-11-22T11:00:00+00:00")
    return replace(run_of(good | change), ended_utc=ended)


def test_a_good_one_passes() -> None:
    check_before_runs(SITE, BASE, [run(), run(columns={})], NOON_S - 7200.0, NOON_S)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"machine": {"name": "other"}}, "another machine"),
        ({"table": {"boot_id": 6}}, "before the control's last start"),
        ({"table": {}}, "before the control's last start"),
        ({"ended_utc": "2026-11-22T09:59:00+00:00"}, "before the machine was identified"),
        ({"ended_utc": ""}, "before the machine was identified"),
        ({}, ""),
        ({"ended_utc": "2026-11-22T12:01:00+00:00"}, "in the future"),
        ({"columns": {"temp_air_C": [20.0, 24.5]}}, "outside of 18 to 24"),
        ({"columns": {"temp_air_C": [20.0, float("nan")]}}, "outside of 18 to 24"),
    ],
)
def test_every_other_is_refused_by_name(change: dict[str, Any], words: str) -> None:
    if not words:
        with pytest.raises(TableRefused, match="older than 72 h"):
            check_before_runs(SITE, BASE, [run()], 0.0, NOON_S + 80 * 3600.0)
        return
    with pytest.raises(TableRefused, match=words):
        check_before_runs(SITE, BASE, [run(**change)], NOON_S - 7200.0, NOON_S)
