"""`abbe demo --artefact` as a user runs it: probe and plate make the machine better in their plane. In the long run: it takes minutes."""

from __future__ import annotations

import json
import os

import pytest

pytestmark = [
    pytest.mark.scenario,
    pytest.mark.timeout(900),
    pytest.mark.skipif(os.environ.get("ABBE_TEST_LONG") != "1", reason="takes minutes: long run"),
]


def test_probe_and_plate_make_the_machine_better_in_their_plane(abbe, tmp_path):
    folder = tmp_path / "kept"
    out, err = abbe("demo", "--artefact", "--json", "--keep", str(folder)).communicate(timeout=850)
    found = json.loads(out)
    assert found["kept"] is True, err
    worst, true = found["measured"]["worst_pose_um"], found["plane_rms_um"]
    assert worst["after"] < 0.4 * worst["before"]
    assert true["after"] < 0.4 * true["before"]
    assert "27 of 27 fields" in " ".join(found["poses"])
    assert (folder / "artefact.html").exists()
