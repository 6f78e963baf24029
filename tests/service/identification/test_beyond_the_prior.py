"""A map that no reading carries is not offered: other people's machines with kinks, bumps and rough screws."""

from __future__ import annotations

import tarfile
from pathlib import Path
from typing import cast

import numpy as np
import pytest

import abbe
from abbe.service.compensation.proposals import propose
from abbe.service.errors import TableRefused
from abbe.service.tables.nine_tables import Base


def campaign(shared: Path, folder: Path, case: str) -> abbe.Campaign:
    with tarfile.open(shared / "data" / "coverage-practice.tar.xz") as tar:
        wanted = [member for member in tar.getmembers() if member.name.removeprefix("./").startswith(f"public/{case}/")]
        tar.extractall(folder, members=wanted, filter="data")
    return abbe.read_campaign(folder / "public" / case)


@pytest.mark.parametrize("case", ["cusp01", "walk00"])
def test_a_rough_machine_gets_six_parameters_and_a_flag_instead_of_a_map_of_millimetres(shared: Path, tmp_path: Path, case: str) -> None:
    rough = campaign(shared, tmp_path, case)
    found = abbe.solve(rough)
    assert found.model == "rigid6"
    (flag,) = [line for line in found.flags if "21 error motions would be" in line]
    assert "solved for rigid6" in flag
    corners = np.stack(np.meshgrid(*rough.site.machine.stroke_mm, indexing="ij"), axis=-1).reshape(-1, 3)
    assert np.abs(found.deviation(corners).value_mm).max() < 0.1
    with pytest.raises(TableRefused, match="cannot carry: 21 error motions would be"):
        propose(rough.site, rough.runs, cast("Base", None), 100)  # refused before the table in force counts
    asked = abbe.solve(rough, model="rigid21")
    assert asked.model == "rigid21"
    assert any("21 error motions would be" in line for line in asked.flags)


def test_a_smooth_machine_keeps_its_map(shared: Path, tmp_path: Path) -> None:
    found = abbe.solve(campaign(shared, tmp_path, "gp00"))
    assert (found.model, found.flags) == ("rigid21", ())
