"""The capture's campaigns at a reduced size; ``ABBE_TEST_LONG=1`` runs them at full size. Real processes, real terminal, real kills."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

LONG = bool(os.environ.get("ABBE_TEST_LONG"))


def campaign(*words: str) -> dict:
    done = subprocess.run(
        [sys.executable, "-m", "tests.experiments.campaigns.capture", *words], capture_output=True, text=True, check=False
    )
    assert done.returncode in (0, 1), done.stderr
    return json.loads(done.stdout)


@pytest.mark.timeout(600)
@pytest.mark.parametrize("speed", [10, 20] if LONG else [20])
def test_under_load_no_sample_is_unaccounted(speed: int) -> None:
    """1 kHz at this many times real time, a core-eater for each core, a locked database, a consumer who stalls the event loop."""
    device_s, lock_s = (600, 30) if LONG else (15, 1)
    found = campaign("load", "--speed", str(speed), "--device-s", str(device_s), "--lock-s", str(lock_s))
    assert found["sent"] + found["corrupted"] + found["suppressed"] >= 1000 * device_s
    assert found["corrupted"] > 0
    assert found["lock_held_s"] >= lock_s
    assert found["stored"] > 0.99 * found["sent"]
    assert found["stored"] + found["in_gaps"] == found["sent"] + found["corrupted"] + found["suppressed"]
    assert {name: found[name] for name in ("unaccounted", "in_no_ledger", "stored_though_not_sent", "twice")} == {
        "unaccounted": 0,
        "in_no_ledger": 0,
        "stored_though_not_sent": 0,
        "twice": 0,
    }


@pytest.mark.timeout(900)
def test_a_killed_recording_loses_nothing_that_was_durable() -> None:
    kills = 200 if LONG else 6
    found = campaign("kills", "--kills", str(kills))
    assert found["violations"] == []
    assert found["kills"] == kills
    assert found["with_durable"] > 0.7 * kills
    assert found["stored"] > 50 * kills
