"""`paper_tables.json` through its reader: everything compared, and an altered digit noticed."""

import random

import pytest

from abbe.service.errors import FileFormatError
from abbe.service.reference.vector_results import check_file
from tests.service.reference.vectors.altering import changed, load, numbers, read


@pytest.fixture
def doc(shared) -> dict:
    return load(shared, "paper_tables")


def test_every_number_of_the_file_holds(shared):
    checks = check_file(shared / "vectors" / "paper_tables.json")
    assert checks.ok
    assert not checks.unread
    assert not checks.not_computable
    assert sum(q.values for q in checks.quantities.values()) == 65
    assert sum(q.values for q in checks.forms.values()) == 18  # Yang's Table 2 is print


def test_an_altered_eighth_digit_of_any_number_is_noticed(doc):
    for path in random.Random(20261121).sample(list(numbers(doc)), 60):
        assert not read("paper_tables", changed(doc, path)).ok, path


def test_another_machine_and_other_readings_are_read_as_well(doc):
    doc["laser_um"] = [round(v * 0.5, 1) for v in doc["laser_um"]]
    doc["diff_um"] = [a - b for a, b in zip(doc["laser_um"], doc["ballbar_um"], strict=True)]
    x, y = doc["x"], doc["laser_um"]
    n = len(x)
    mx, my = sum(x) / n, sum(y) / n
    slope = sum((a - mx) * (b - my) for a, b in zip(x, y, strict=True)) / sum((a - mx) ** 2 for a in x)
    doc["slope_origin"] = sum(a * b for a, b in zip(x, y, strict=True)) / sum(a * a for a in x) * 1e-3
    doc["slope_ols"], doc["intercept_um"] = slope * 1e-3, my - slope * mx
    x_mm, y_mm, z_mm = 300.0, 400.0, 1200.0
    xy, xz, yz = 1e-5, 2e-5, -3e-5
    terms = {"ppp": (1, 1, 1), "npp": (-1, -1, 1), "pnp": (-1, 1, -1), "ppn": (1, -1, -1)}  # products of the signs: XY, XZ, YZ
    doc["pahk_C"] = {
        "volume": [x_mm, y_mm, z_mm],
        "squareness_xy_xz_yz": [xy, xz, yz],
        "printed_diag_um": [1.0, 2.0, 3.0, 5.0],
        "squareness_only_um": {
            k: -1e3 * (a * xy * x_mm * y_mm + b * xz * x_mm * z_mm + c * yz * y_mm * z_mm) / 1300.0 for k, (a, b, c) in terms.items()
        },
        "mean_um": 2.75,
    }
    assert read("paper_tables", doc).ok


def test_a_missing_table_is_named(doc):
    doc.pop("table2")
    with pytest.raises(FileFormatError, match="table2"):
        read("paper_tables", doc)
