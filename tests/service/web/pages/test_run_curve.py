"""Readings of a run for a screen that zooms: peaks stay, a closer look shows readings, and what cannot be shown says so."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import pytest

from abbe.service.runs.columns import BAR_CODEC, bar_samples
from abbe.service.storage.store import Store
from abbe.service.web.pages.run_curve import PARTS, envelope, run_curve
from tests.experiments.campaigns.plots import fill
from tests.pages_world import Served, as_user


def test_a_million_readings_keep_their_peaks_and_become_readings_as_one_looks_closer() -> None:
    t_s = np.arange(1_000_000) / 3000.0
    y = 0.001 * np.sin(t_s)
    y[777_777] = 0.5
    x, low, high = envelope(t_s, y, 0.0, t_s[-1])
    assert len(x) == PARTS
    assert high.max() == 0.5
    assert low.min() == pytest.approx(-0.001, rel=1e-6)
    x, low, high = envelope(t_s, y, 259.2, 259.3)
    assert (x[0] <= 259.2, x[-1] >= 259.3, len(x)) == (True, True, 303)
    assert np.array_equal(low, high)
    assert x[np.argmax(high)] == t_s[777_777]


def test_the_readings_of_a_stored_run_in_the_readers_unit(running: Served) -> None:
    with as_user(running, "vera") as client:
        whole = client.get("/run/curve?id=1").json()
        inches = client.get("/run/curve?id=1&units=inch").json()
        part = client.get(f"/run/curve?id=1&low={whole['whole'][0] + 1}&high={whole['whole'][0] + 20}").json()
        wrong = [client.get(f"/run/curve?{query}") for query in ("id=999", "id=18", "id=1&low=2&high=1", "low=nan", "id=x")]
    assert len(whole["x"]) == whole["readings"] > 100
    assert np.array(inches["high"]) == pytest.approx(np.array(whole["high"]) / 0.0254, rel=1e-3)
    assert 2 < len(part["x"]) < len(whole["x"])
    assert [one.status_code for one in wrong] == [404, 404, 422, 422, 422]


def test_a_run_that_grows_is_read_anew_and_the_last_ones_are_kept(tmp_path: Path) -> None:
    with Store.open(fill(tmp_path, 0, 4000).url) as store:
        for _ in range(2):
            whole = run_curve(store, 1, -1e12, 1e12)
            assert (len(whole["x"]), whole["readings"]) == (PARTS, 4000)
        begin_s = whole["whole"][0]
        assert len(run_curve(store, 1, begin_s + 1.0, begin_s + 1.5)["x"]) in range(501, 505), "a closer look shows the readings"
        other = store.runs.start(store.campaigns.find("long").id, "r02", "ballbar_circle", "identify", store.runs.find(1).start_doc)
        samples, seen = bar_samples(store.chunks.of_run(1)), []
        for number in (0, 1):
            part = samples[1000 * number : 1000 * (number + 1)]
            store.chunks.append(other, "bar", number, part.size, BAR_CODEC, zlib.compress(part.tobytes()), 0.0, 0.0, 0, 1)
            seen.append(run_curve(store, other, -1e12, 1e12)["readings"])
    assert 0 < seen[0] < seen[1], "what has come since is shown"
