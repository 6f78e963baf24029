"""A machine identified from an uncalibrated plate in four poses: `abbe solve CAMPAIGN --at POINTS --out FILE`."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from abbe.service.cli.app import app
from abbe.service.errors import CampaignRefused
from tests.artefact_campaign import PITCH_MM, campaign, error_mm

pytestmark = pytest.mark.usefixtures("solved_once")
GRID = np.array([[x, y] for x in np.linspace(300.0, 500.0, 5) for y in np.linspace(140.0, 340.0, 5)])


def solved(folder: Path, tmp_path: Path, model: str = "rigid21") -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Deviation and U in the plane, um, and the comments of the answer."""
    at, out = tmp_path / "at.csv", tmp_path / "out.csv"
    at.write_text("x_mm,y_mm,z_mm\n" + "\n".join(f"{x},{y},200" for x, y in GRID) + "\n")
    done = CliRunner().invoke(app, ["solve", str(folder), "--at", str(at), "--out", str(out), "--model", model])
    assert done.exit_code == 0, done.output
    lines = out.read_text().splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert {r["dz_um"] for r in rows} == {""}  # not sensed, so nothing is claimed
    found = np.array([[float(r["dx_um"]), float(r["dy_um"])] for r in rows])
    return found, np.array([[float(r["U_dx_um"]), float(r["U_dy_um"])] for r in rows]), [line for line in lines if line.startswith("#")]


def without_motion(d: np.ndarray, *, scale: bool) -> np.ndarray:
    """Deviations at the grid without their best-fit motion of the plane, and scale."""
    away = GRID - GRID.mean(axis=0)
    columns = [np.tile([1.0, 0.0], (25, 1)), np.tile([0.0, 1.0], (25, 1)), np.stack([-away[:, 1], away[:, 0]], 1)] + [away] * scale
    a = np.stack(columns, axis=-1).reshape(50, -1)
    return (d.ravel() - a @ np.linalg.lstsq(a, d.ravel(), rcond=None)[0]).reshape(25, 2)


@pytest.mark.parametrize("length", [True, False])
def test_a_plate_tells_the_machine_and_without_a_length_all_but_the_scale(tmp_path: Path, length: bool) -> None:
    """The holes are off by 20 um, the machine by about as much: the answer is right within its uncertainty."""
    found, u, notes = solved(campaign(tmp_path, length=length), tmp_path)
    off = found - without_motion(error_mm(*GRID.T) * 1e3, scale=not length)
    assert np.abs(off).max() < 0.6
    assert (np.abs(off) < u).mean() > 0.8
    assert u.max() < 2.5
    assert any("scale is not observable" in line for line in notes) == (not length)
    assert not any("run p" in line for line in notes)  # a good campaign is not blamed


def test_the_points_are_kept_in_the_database_as_they_were(tmp_path: Path) -> None:
    """Feature names and directions that were not sensed come back from an export unchanged."""
    runner, db = CliRunner(), f"sqlite:///{tmp_path}/a.sqlite3"
    folder = campaign(tmp_path)
    assert runner.invoke(app, ["import", str(folder), "--db", db]).exit_code == 0
    done = runner.invoke(app, ["export", "plate", str(tmp_path / "out"), "--db", db])
    assert done.exit_code == 0, done.output
    for name in ("campaign.json", "p1.json", "p4.json"):
        assert json.loads((tmp_path / "out" / name).read_text()) == json.loads((folder / name).read_text())


def _spoil(folder: Path, fault: str) -> None:
    """Change one run of a campaign as such a fault would."""
    path = folder / "p2.json"
    run = json.loads(path.read_text())
    c = run["columns"]
    if fault == "false trigger":
        c["deviation_x_mm"][7] += 0.12
    elif fault == "exchanged":
        c["feature"][7], c["feature"][9] = c["feature"][9], c["feature"][7]
        for k, off in ((7, -2.0 * PITCH_MM), (9, 2.0 * PITCH_MM)):
            c["deviation_x_mm"][k] += off
    else:
        c["deviation_x_mm"] = [d + 0.012 * (i >= 12) for i, d in enumerate(c["deviation_x_mm"])]
    path.write_text(json.dumps(run))


def test_a_label_that_contradicts_the_position_of_its_point_is_refused(tmp_path: Path) -> None:
    """Labels were exchanged, but not the deviations: as read, both features would keep a wrong form in silence."""
    folder = campaign(tmp_path)
    path = folder / "p2.json"
    run = json.loads(path.read_text())
    names = run["columns"]["feature"]
    names[7], names[9] = names[9], names[7]
    path.write_text(json.dumps(run))
    with pytest.raises(CampaignRefused, match="run p2: feature E2: position and pose place it 111 mm from where its deviation places it"):
        CliRunner().invoke(app, ["solve", str(folder)], catch_exceptions=False)
    names[7], names[9] = names[9], names[7]
    run["setup"]["pose"]["origin_mm"] = [0.0, 0.0, 0.0]  # not stated: the solution fits it
    path.write_text(json.dumps(run))
    assert CliRunner().invoke(app, ["solve", str(folder), "--model", "rigid6"], catch_exceptions=False).exit_code == 0


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("false trigger", "run p2: a false trigger at C2: the reading is off by 120 µm - left out"),
        ("exchanged", "run p2: the labels of features C2 and E2 are exchanged - exchanged back"),
        ("moved", "run p2: the artefact moved before point 13"),
        ("rotated", "run p2: the artefact lay rotated by 90 degrees"),
    ],
)
def test_a_fault_is_named_in_the_verdict(tmp_path: Path, fault: str, words: str) -> None:
    """One run of four is spoiled; the small model is enough to say how."""
    campaign(tmp_path, turned="p2" if fault == "rotated" else "")
    if fault != "rotated":
        _spoil(tmp_path, fault)
    _, _, notes = solved(tmp_path, tmp_path, "rigid6")
    assert any(line.startswith("# verdict: ") and words in line for line in notes), notes
