"""A map that no reading carries is not offered: other people's machines with kinks, bumps and rough screws."""

from __future__ import annotations

import os
import tarfile
from pathlib import Path

import numpy as np
import pytest

import abbe
from abbe.models.solvers.assessment import MapAgainstPrior

LONG = os.environ.get("ABBE_TEST_LONG") == "1"


def campaign(shared: Path, folder: Path, case: str) -> abbe.Campaign:
    with tarfile.open(shared / "data" / "coverage-practice.tar.xz") as tar:
        wanted = [member for member in tar.getmembers() if member.name.removeprefix("./").startswith(f"public/{case}/")]
        tar.extractall(folder, members=wanted, filter="data")
    return abbe.read_campaign(folder / "public" / case)


@pytest.mark.parametrize("case", ["cusp01"] + ["walk00"] * LONG)
def test_a_rough_machine_gets_a_map_that_stays_in_the_size_of_machines(shared: Path, tmp_path: Path, case: str) -> None:
    """Before motions had rough parts and bounded sizes, these maps reached millimetres."""
    rough = campaign(shared, tmp_path, case)
    found = abbe.solve(rough)
    assert found.model == "rigid21"
    corners = np.stack(np.meshgrid(*rough.site.machine.stroke_mm, indexing="ij"), axis=-1).reshape(-1, 3)
    assert np.abs(found.deviation(corners).value_mm).max() < 0.1
    assert not any("21 error motions would be" in line for line in found.flags)


def test_a_map_larger_or_less_known_than_the_prior_allows_is_not_carried_by_its_readings() -> None:
    assert MapAgainstPrior(predicted_mm=0.10, u_mm=0.01, prior_mm=0.05, measured_mm=0.06).carried
    assert not MapAgainstPrior(predicted_mm=0.16, u_mm=0.01, prior_mm=0.05, measured_mm=0.06).carried
    assert not MapAgainstPrior(predicted_mm=0.01, u_mm=0.06, prior_mm=0.05, measured_mm=0.06).carried
    assert not MapAgainstPrior(predicted_mm=0.10, u_mm=0.04, prior_mm=0.05, measured_mm=0.02).carried
    assert MapAgainstPrior(predicted_mm=0.10, u_mm=0.01, prior_mm=0.05, measured_mm=0.02).carried, "squareness, from small circles"


def test_a_smooth_machine_keeps_its_map(shared: Path, tmp_path: Path) -> None:
    found = abbe.solve(campaign(shared, tmp_path, "gp00"))
    assert found.model == "rigid21"
    assert not any("21 error motions would be" in line for line in found.flags)
