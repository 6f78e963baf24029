"""Lists of an artefact's points: CSV with named columns, and reports of plug plates."""

from __future__ import annotations

from pathlib import Path

import pytest

from abbe.models.solvers.plate_fit import plate_fit
from abbe.service.errors import AbbeError
from abbe.service.instrument_files.point_list import campaign_of_points, is_point_list
from abbe.service.runs.observations import run_data

CSV = """# artefact: P
# source: machine-probe
# tool_mm: 0, 0, -60
# origin_mm: 100 200 50
# rotation_deg: 90
# calibrated_length: A B 60.0012 0.0004
feature,nominal_x_mm,nominal_y_mm,x_mm,y_mm,z_mm
A,0,0,100.01,200.02,50
B,60,0,100.01,260.03,50
C,0,60,40.01,200.02,50
D,60,60,40.01,260.02,50
"""


def test_positions_become_deviations_in_the_axes_of_the_artefact(tmp_path: Path) -> None:
    """The plate lies turned by 90 degrees: its x is the machine's Y."""
    file = tmp_path / "one.csv"
    file.write_text(CSV)
    assert is_point_list(file)
    folder = campaign_of_points([file], "plates", None)
    columns = folder.run_files[0]["columns"]
    assert columns["deviation_x_mm"] == pytest.approx([0.02, 0.03, 0.02, 0.02])
    assert columns["deviation_y_mm"] == pytest.approx([-0.01] * 4)
    known = folder.campaign["artefacts"]["P"]["calibrated_lengths"]
    assert known == [{"from": "A", "to": "B", "length_mm": 60.0012, "U_mm": 0.0004, "k": 2}]
    assert run_data(folder.runs[0]).deviation_mm.size == 12


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (CSV.replace("60,60,40.01", "60,sixty,40.01"), "one.csv:11: nominal_y_mm is 'sixty', expected a number"),
        (CSV.replace(",z_mm", ",height_mm"), "one.csv:7: column 'z_mm' is missing"),
        (CSV.replace("# origin_mm", "# origin"), "one.csv:4: unknown key 'origin'"),
        (CSV.replace("D,60,60,40.01,260.02,50", "D,60,60"), "one.csv:11: 3 values for 6 columns"),
        (CSV.replace("A B 60.0012 0.0004", "A Q 60.0012 0.0004"), "no feature has the id 'Q'"),
    ],
)
def test_a_mistake_is_told_with_its_line(tmp_path: Path, wrong: str, words: str) -> None:
    """One clear line; nothing is stored."""
    file = tmp_path / "one.csv"
    file.write_text(wrong)
    with pytest.raises(AbbeError, match=words.replace("(", r"\(")):
        campaign_of_points([file], "plates", None)


PRINTED = {  # EXX, EYY um/m, C0Y urad of a plain affine fit; offset, rotation deg as the observatory printed them
    "D8131_1": ((3, 11, 35), (-0.044, 0.079), 0.029),
    "D8300_1": ((5, -6, 6), (0.271, 0.080), -0.027),
    "D1597A_orig_meas_2003": ((-2, 31, -3), None, None),
}


@pytest.mark.parametrize("name", PRINTED)
def test_plug_plates_of_a_production_mill_give_the_printed_fits(shared: Path, name: str) -> None:
    """Plates drilled on a mill, measured on a CMM 2003 to 2014; the swirl of 1597A is unknown, 8300 shows nothing."""
    (scales, offset, rotation) = PRINTED[name]
    run = campaign_of_points([shared / "data" / "foreign" / "plugplates" / name], name, None).runs[0]
    found = plate_fit(run_data(run))
    assert found is not None
    assert [round(v * 1e6) for v in found.value[:3]] == list(scales)
    assert 8e-6 < found.expanded[:3].min() < found.expanded[:3].max() < 32e-6
    if offset is not None:
        assert found.offset_mm == pytest.approx(offset, abs=6e-4)
        assert found.rotation_rad * 57.29578 == pytest.approx(rotation, abs=6e-4)
    word = {"D8131_1": "", "D8300_1": "none", "D1597A_orig_meas_2003": "unknown: one plate cannot show"}[name]
    assert found.verdict.startswith(word)
