"""What moves with a plate, and what stays with the machine: amounts with U, and "unknown" where the poses cannot tell."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from abbe.models.solvers.artefact_shares import _in_the_part, _verdict
from abbe.models.solvers.observability.poses import NAMED, stated_places
from abbe.service.campaign_data.campaign_folder import from_folder
from abbe.service.cli.app import app
from abbe.service.discovery.artefact_finding import ArtefactFinding, artefact_finding
from abbe.service.runs.artefact_points import artefact_data
from tests.artefact_campaign import Error, campaign, error_mm, nominal, screws_mm

pytestmark = pytest.mark.usefixtures("solved_once")
LONG = os.environ.get("ABBE_TEST_LONG") == "1"
REACH_MM = float(np.hypot(111.0, 111.0))


def amounts(q: np.ndarray, moved: np.ndarray) -> list[float]:
    """Named fields of displacements at places (n, 2) from the centre, by least squares beside rigid motions."""
    columns = [
        np.tile([1.0, 0.0], (len(q), 1)),
        np.tile([0.0, 1.0], (len(q), 1)),
        np.stack([-q[:, 1], q[:, 0]], 1),
        *(f(q) for f in NAMED.values()),
    ]
    return np.linalg.lstsq(np.stack(columns, -1).reshape(2 * len(q), -1), moved.ravel(), rcond=None)[0][3:].tolist()


def found_and_true(folder: Path, seed: int, error: Error) -> tuple[ArtefactFinding, list[float], list[float]]:
    """The finding, and the true amounts of the named fields in part and machine, mm."""
    found = artefact_finding(from_folder(campaign(folder, seed=seed, error=error)))
    form = 0.02 * np.random.default_rng(seed).standard_normal((25, 2))
    probed = [r for r in found.solved.joint.data if r.points.source == "probe"]
    at = np.concatenate([stated_places(r.axes_mm, r.points.matrix, r.points.nominal_mm, [0, 1]) for r in probed])
    machine = amounts((at - 0.5 * (at.min(axis=0) + at.max(axis=0))) / REACH_MM, error(*at.T))
    return found, amounts((nominal() - 111.0) / REACH_MM, form), machine


@pytest.mark.parametrize("seed", [1, 2] if LONG else [1])
def test_the_amounts_of_part_and_machine_are_those_that_were_put_in(tmp_path: Path, seed: int) -> None:
    found, part, machine = found_and_true(tmp_path, seed, error_mm)
    for share, p, m in zip(found.shares, part, machine, strict=True):
        assert abs(share.part_mm - p) < 3.0 * share.u_part_mm + 2e-5, share
        assert abs(share.machine_mm - m) < 3.0 * share.u_machine_mm + 2e-5, share
        if abs(m) > 1e-3 or abs(m) < 2e-4:
            assert (share.verdict in ("with the machine", "with both")) == (abs(m) > 1e-3), share
    assert "squareness" in found.verdict


def test_the_amounts_of_a_machine_with_screw_errors_lie_within_their_uncertainty_and_only_its_leads_are_named(tmp_path: Path) -> None:
    z = []
    for seed in (1, 2) if LONG else (2,):
        (tmp_path / str(seed)).mkdir()
        found, part, machine = found_and_true(tmp_path / str(seed), seed, screws_mm)
        z += [(s.machine_mm - m) / s.u_machine_mm for s, m in zip(found.shares, machine, strict=True)]
        z += [(s.part_mm - p) / s.u_part_mm for s, p in zip(found.shares, part, strict=True)]
        named = [float(wave.split()[3]) for wave in found.waves]
        assert any(abs(period - 10.0) < 0.05 for period in named)
        assert all(min(abs(period - 10.0), abs(period - 40.0 / 3.0)) < 0.1 for period in named), named
    assert np.abs(z).max() < 3.0
    assert np.sqrt(np.mean(np.square(z))) < 1.3


def test_what_the_solution_does_not_follow_of_the_machine_counts_as_form_of_the_part(tmp_path: Path) -> None:
    """A deviation of each reading shifts its feature by a quarter: four poses touch it once each."""
    probed = [p for r in from_folder(campaign(tmp_path)).runs if (p := artefact_data(r, r.setup).points).source == "probe"]
    places = {f: n for p in probed for f, n in zip(p.feature, p.nominal_mm, strict=True)}
    moved = np.random.default_rng(3).standard_normal((sum(len(p.feature) for p in probed), 3))
    shift, start = {f: np.zeros(3) for f in places}, 0
    for p in probed:
        for feature, component, d in zip(p.feature, p.component, moved[start:], strict=False):
            shift[feature][component] += d @ p.matrix[:, component] / len(probed)
        start += len(p.feature)
    part = amounts((nominal() - 111.0) / REACH_MM, np.array([shift[f][:2] for f in places]))
    assert np.einsum("frc,rc->f", _in_the_part(probed, places), moved) == pytest.approx(part)


def test_what_only_the_reading_shows_is_unknown_and_not_none():
    assert _verdict([False, False, True], hidden=False) == "unknown"
    assert _verdict([False, False, False], hidden=False) == "none"


def test_what_these_poses_hide_is_unknown_and_the_pose_that_tells_is_named(tmp_path: Path) -> None:
    folder = campaign(tmp_path, length=False)
    done = CliRunner().invoke(app, ["discover", str(folder), "--without", "p2", "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    verdicts = {f["field"]: f["verdict"] for f in found["fields"]}
    assert verdicts["scale"] == verdicts["difference of the scales"] == verdicts["squareness"] == "unknown"
    assert "turned by 90 degrees" in found["poses"]["text"]
    assert "unknown, part or machine: scale, difference of the scales, squareness" in found["verdict"]
    said = CliRunner().invoke(app, ["discover", str(folder), "--without", "p2"]).output
    assert "A further pose turned by 90 degrees would show: difference of the scales, squareness" in " ".join(said.split())
