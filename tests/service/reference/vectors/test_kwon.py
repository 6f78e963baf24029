"""The two Kwon vector files: every quantity agrees, and an altered 8th digit anywhere is noticed."""

from __future__ import annotations

import copy
import os
from pathlib import Path

import numpy as np
import pytest

from abbe.service.errors import FileFormatError
from abbe.service.reference.vector_results import check_file
from tests.service.reference.vectors.altering import changed, load, numbers, read, value

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
"""Three times as many altered digits."""
FILES = ("kwon_kinematics", "kwon_rsm")


@pytest.mark.parametrize("name", FILES)
def test_every_quantity_agrees(shared: Path, name: str) -> None:
    checks = check_file(shared / "vectors" / f"{name}.json")
    assert checks.ok, [f for q in checks.quantities.values() for f in q.failures] + checks.unread


def test_largest_deviations_are_rounding(shared: Path) -> None:
    q = check_file(shared / "vectors" / "kwon_kinematics.json").quantities
    assert q["forward solution"].max_abs < 1e-13
    assert q["inverse solution"].max_abs < 1e-13
    assert q["dP/dlambda"].max_abs < 1e-14
    assert q["dP/dparameter"].max_abs < 1e-13
    assert q["errors, best fit"].max_abs < 2e-13


def test_only_the_shift_of_the_placement_is_left_out(shared: Path) -> None:
    checks = check_file(shared / "vectors" / "kwon_kinematics.json")
    assert sum(n.numbers for n in checks.not_computable) == 3
    assert not check_file(shared / "vectors" / "kwon_rsm.json").not_computable


UNSEEN = {("frame", "T_pm_to_cmm", k, 3) for k in range(3)}
"""The shift that no input determines."""


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("factor", [1 + 5e-8, 1 - 5e-8])
def test_altered_digit_is_noticed(shared: Path, name: str, factor: float) -> None:
    doc = load(shared, name)
    where = [p for p in numbers(doc) if abs(value(doc, p)) > 1e-12 and p not in UNSEEN]
    where += [p for p in numbers(doc) if p[-1] == "p_value"]
    for i in np.random.default_rng(4).choice(len(where), 60 if LONG else 20, replace=False):
        assert not read(name, changed(doc, where[i], factor)).ok, where[i]


def test_a_machine_of_twice_the_size(shared: Path) -> None:
    """Similarity: lengths and commands doubled double the positions and the effect of angles, and nothing else."""
    doc = load(shared, "kwon_kinematics")
    twice = copy.deepcopy(doc)
    for key in ("R", "r", "l", "lup", "ldw", "le"):
        twice["geometry"][key] *= 2
    for case in twice["fk"]:
        for key in ("lambda", "P", "ik", "P_printed_eq4"):
            case[key] = [2 * v for v in case[key]]
    twice["fk"] = twice["fk"][:4]
    twice["example"] = {k: [2 * v for v in values] for k, values in twice["example"].items()}
    for key in ("thb", "thp"):
        twice["param_jacobian_at_example"][key] = (2 * np.array(doc["param_jacobian_at_example"][key])).tolist()
    checks = read("kwon_kinematics", twice)
    assert [q.name for q in checks.quantities.values() if not q.ok] == ["stroke for +-1 mm"]  # the square is not doubled
    assert not checks.unread


def test_missing_part_is_named(shared: Path) -> None:
    doc = load(shared, "kwon_kinematics")
    del doc["fk"][3]["ik"]
    with pytest.raises(FileFormatError, match=r"fk/3.*'ik' is missing"):
        read("kwon_kinematics", doc)


def test_missing_plane_is_named(shared: Path) -> None:
    doc = load(shared, "kwon_rsm")
    del doc["ey@Z=113.61 (printed)"]
    with pytest.raises(FileFormatError, match="ey has no printed plane"):
        read("kwon_rsm", doc)


def test_added_number_is_noticed(shared: Path) -> None:
    doc = load(shared, "kwon_rsm")
    doc["table2 ex"]["new"] = 1.0
    assert read("kwon_rsm", doc).unread == ["kwon_rsm/table2 ex/new"]
