"""Means (.pos, .REN), ball-bar results (.b5r), traces (.rtx), and any table with a column file."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from abbe.service.errors import FileFormatError
from abbe.service.instrument_files.answers import Answers, open_questions, settled
from abbe.service.instrument_files.campaign import campaign_of
from abbe.service.instrument_files.columns import column_file, toml_of
from abbe.service.instrument_files.content import Content
from abbe.service.instrument_files.registry import likely_heading, read_file
from tests.service.instrument_files.examples import B5R, COLUMNS, POS, REN, TABLE, rtx


class Folder:
    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self, name: str, content: str | bytes, columns: str = "") -> Content:
        file = self.path / name
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
        (self.path / "columns.toml").write_text(columns or COLUMNS)
        return read_file(file, column_file(self.path / "columns.toml"))

    def refused(self, name: str, content: str | bytes, columns: str = "") -> str:
        with pytest.raises(FileFormatError) as refused:
            self.read(name, content, columns)
        assert "\n" not in str(refused.value)
        return str(refused.value).removeprefix(f"{self.path}/")


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


def keys(content: Content) -> list[str]:
    return [one.key for one in open_questions(content, Answers())]


def test_means_of_both_ways_are_one_approach_from_each_side(folder: Folder) -> None:
    content = folder.read("y.pos", POS)
    assert keys(content) == ["sign"]
    test = settled(content, Answers(sign="nominal-measured"))
    assert test is not None
    assert (test.axis, test.direction.tolist(), test.position_mm.tolist()) == ("Y", [1, 1, 1, -1, -1, -1], [0, 100, 200, 200, 100, 0])
    np.testing.assert_allclose(test.deviation, [0, 0.005, 0.011, 0.008, 0.0025, -0.003])
    assert content.notes == ("the values are means: no repeatability",)


def test_means_of_both_directions_together_show_no_reversal(folder: Folder) -> None:
    only = POS[: POS.index("Position   \tForward")]
    made = campaign_of([folder.read("y.pos", only)], Answers(sign="measured-nominal"), "c", None)
    assert made.folder.runs == []
    (readings,) = made.folder.campaign["readings"]
    assert (readings["kind"], readings["direction"], readings["deviation"]) == ("mean", [0, 0, 0], [0.0015, -0.00375, -0.0095])


def test_what_is_wrong_in_a_pos(folder: Folder) -> None:
    assert folder.refused("y.pos", POS[: POS.index("Position   \tReverse")]).startswith(
        "y.pos:12: the table of the other direction is missing"
    )
    assert folder.refused("y.pos", POS.replace("-0.00375", "-0.0057")).startswith("y.pos:7: the mean of both directions is -0.0057, but")
    assert folder.refused("y.pos", POS.replace("0.0000\t0.0030", "0.0000")).startswith("y.pos:14: 1 values, expected a position and a mean")
    assert folder.refused("y.pos", POS.replace("200.0000\t-0.0080", "50\t-0.008")).startswith("y.pos:16: position 50 after 100")
    assert folder.refused("y.pos", "hello\n").startswith("y.pos:1: no table")
    other = POS.replace("Reverse Directional Avg Error", "Forward Sigma")
    assert folder.refused("y.pos", other).startswith("y.pos:13: 'Position   \\tForward Sigma' is not a known table")


def test_a_compensation_report_says_its_unit_or_is_asked(folder: Folder) -> None:
    content = folder.read("x.REN", REN)
    assert keys(content) == ["sign"]
    test = settled(content, Answers(sign="measured-nominal"))
    assert test is not None
    np.testing.assert_allclose(test.deviation, [0, -0.0015, -0.003, 0.0025])
    unknown = folder.read("x.REN", REN.replace("micrometres", ""))
    assert keys(unknown) == ["unit", "sign"]
    test = settled(unknown, Answers(unit="mm", sign="measured-nominal"))
    assert test is not None
    assert test.deviation[1] == -1.5


def test_what_is_wrong_in_a_ren(folder: Folder) -> None:
    assert folder.refused("x.REN", REN.replace("3       100", "4       100")).startswith("x.REN:12: the number is '4', expected 3")
    assert folder.refused("x.REN", REN.replace("100.000   ", "101.000   ")).startswith(
        "x.REN:12: expected 4 positions from 0 to 150 in steps of 50"
    )
    assert folder.refused("x.REN", REN[: REN.index("4       150")]).startswith("x.REN:12: expected 3 positions from 0 to 150")
    assert folder.refused("x.REN", REN.replace("-3.0", "")).startswith("x.REN:12: 2 values, expected number, position and value")


@pytest.mark.parametrize(("encoding", "machine"), [("utf-8", "VMC-1"), ("gbk", "立式加工中心")])
def test_results_of_a_ball_bar(folder: Folder, encoding: str, machine: str) -> None:
    content = folder.read("xy.b5r", B5R.format(encoding=encoding, machine=machine).encode(encoding))
    assert content.machine == machine
    found = {one.symbol: (one.value, one.unit) for one in content.stated}
    assert found == {
        "AF_CIRCULARITY": (11.4, "µm"),
        "AF_SQUARENESS": (-18.2, "µm/m"),
        "AF_SERVO_MISMATCH": (0.21, "ms"),
        "AF_BACKLASH_A_POS": (-2.6, "µm"),
    }
    assert "the trace (radius against angle) was not read" in content.notes[-1]


def test_what_is_wrong_in_a_b5r(folder: Folder) -> None:
    good = B5R.format(encoding="utf-8", machine="m")
    assert folder.refused("xy.b5r", good[:700]).startswith("xy.b5r:16: not XML: ")
    assert folder.refused("xy.b5r", good.replace(">11.4<", ">11,4<")).startswith("xy.b5r:10: AF_CIRCULARITY is '11,4', expected a number")
    twice = good.replace('NAME="AF_SQUARENESS" DT="UT_SQUARENESS"', 'NAME="AF_CIRCULARITY" DT="UT_LENGTH_UM"')
    assert folder.refused("xy.b5r", twice).startswith("xy.b5r:13: a second AF_CIRCULARITY (the first is in line 10)")
    assert folder.refused("xy.b5r", good.replace('"XY"', '"QQ"')).startswith("xy.b5r:8: the plane is QQ")
    bomb = good.replace("<BALLBAR_TEST>", '<!DOCTYPE x [<!ENTITY a "b">]><BALLBAR_TEST>')
    assert folder.refused("xy.b5r", bomb).startswith("xy.b5r:2: the file has a DOCTYPE, which Abbe does not read")


def test_a_trace_of_a_standing_axis(folder: Folder) -> None:
    """The samples' bytes may look like text: EOF:: inside of one is no end."""
    odd = float(np.frombuffer(b"EOF::\r\nA", "<f8")[0])
    content = folder.read("d.rtx", rtx((0.0, 1.5e-3, -2.0, odd)))
    assert content.trace is not None
    assert content.trace.samples.tolist() == [0.0, 1.5e-3, -2.0, odd]
    assert keys(content) == ["axis", "unit", "at_mm"]
    run = campaign_of([content], Answers(axis="Z", unit="um", at_mm=120.0), "c", None).folder.run_files[0]
    assert run["columns"]["z_mm"] == [120.0] * 4
    np.testing.assert_allclose(run["columns"]["deviation_mm"][:3], [0, 1.5e-6, -2e-3])
    np.testing.assert_allclose(run["columns"]["t_s"], np.arange(4) / 50000.0)


def test_a_long_trace_is_averaged_in_blocks(folder: Folder) -> None:
    samples = np.arange(250_000.0)
    made = campaign_of([folder.read("d.rtx", rtx(list(samples)))], Answers(axis="X", unit="mm", at_mm=0.0), "c", None)
    columns = made.folder.run_files[0]["columns"]
    assert len(columns["t_s"]) == 83_333
    np.testing.assert_allclose(np.diff(columns["deviation_mm"]), 3.0)
    np.testing.assert_allclose(columns["t_s"][:2], np.array([1, 4]) / 50000.0)


def test_what_is_wrong_in_a_rtx(folder: Folder) -> None:
    assert folder.refused("d.rtx", rtx()[:-1]).startswith("d.rtx:19: 30 bytes follow, but 3 samples and EOF:: have 31")
    assert folder.refused("d.rtx", rtx(count=4)).startswith("d.rtx:19: 31 bytes follow, but 4 samples")
    assert folder.refused("d.rtx", rtx((0.0, float("nan")))).startswith("d.rtx:19: sample 2 is nan, expected -1e+12 to 1e+12")
    assert folder.refused("d.rtx", rtx(rate="50 kHz")).startswith("d.rtx:8: Actual sample rate is '50 kHz', expected a number")
    assert folder.refused("d.rtx", b"HEADER::\r\n").startswith("d.rtx:1: not an .rtx file")


def test_a_table_with_a_column_file(folder: Folder) -> None:
    test = folder.read("t.csv", TABLE).test
    assert test is not None
    assert (test.axis, test.direction.tolist()) == ("X", [1, 1, 1, -1, -1, -1])
    np.testing.assert_allclose(test.deviation * 1e3, [0, -5, -11, -8, -2.5, 3], atol=1e-9)
    assert test.resolution == pytest.approx(1e-4)
    np.testing.assert_allclose(test.further["temp_air_C"], [20.5, 20.5, 20.6, 20.6, 20.6, 20.6])


def test_without_a_column_of_the_direction_the_order_decides(folder: Folder) -> None:
    columns = COLUMNS.replace('[direction]\ncolumn = "Dir"\n', "")
    content = folder.read("t.csv", TABLE, columns)
    assert content.test is not None
    assert content.test.direction.tolist() == [1, 1, 1, -1, -1, -1]
    assert "the order of the targets decided the direction" in content.notes[0]
    again = TABLE.replace("200,0;199,9890;+;20,6\n", "200,0;199,9890;+;20,6\n" * 2)
    assert folder.refused("t.csv", again, columns).startswith("t.csv:7: target 200 mm three times in a row")


COLUMNS_BY_COMMA = COLUMNS.replace("heading = 2", "heading = 1")[: COLUMNS.index("[air")]
WRONG = {
    "comma or point": (TABLE.replace("99,9950", "99.9950"), "", "t.csv:4: '99.9950' has a point, but the decimal sign is a comma"),
    "not a number": (TABLE.replace("99,9950", "err"), "", "t.csv:4: measured is 'err', expected a number"),
    "a cell too few": (TABLE.replace("99,9975;-;20,6", "99,9975"), "", "t.csv:7: the direction is 'missing'"),
    "another word": (TABLE.replace("99,9975;-", "99,9975;back"), "", "t.csv:7: the direction is 'back', expected '+' or '-'"),
    "no such column": (TABLE.replace("Target", "Soll"), "", "t.csv:2: no column 'Target'; headings are Soll, Reading, Dir, Air"),
    "twice the heading": (TABLE.replace("Air", "Target"), "", "t.csv:2: two columns 'Target'"),
    "commas": ("Target,Reading,Dir\n0,0,0,+\n100,0,99,+\n", COLUMNS_BY_COMMA, "t.csv:2: 4 cells under 3 headings: are decimals or the"),
    "Fahrenheit": (TABLE.replace("20,5", "68,9"), "", "t.csv:3: air temperature is 68.9, expected -20 to 50: is the unit C?"),
    "unit": (
        TABLE,
        COLUMNS.replace('unit = "mm"', 'unit = "furlong"', 1),
        "columns.toml: target.unit is 'furlong', expected one",
    ),
    "both": (TABLE, COLUMNS + '[deviation]\ncolumn = 1\nunit = "mm"\n', "columns.toml: expected either measured (positions) or deviation"),
    "positions": (TABLE, COLUMNS.replace("[measured]", "[deviation]"), "t.csv:5: the deviations follow the targets (199.989 mm at 200 mm)"),
    "unknown key": (TABLE, 'axes = "X"\n' + COLUMNS, "columns.toml: axes: Extra inputs are not permitted"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_in_a_table(folder: Folder, wrong: str) -> None:
    table, columns, message = WRONG[wrong]
    assert folder.refused("t.csv", table, columns).startswith(message)


DRIFT = "t min;x um;spindle\n0;2.0;20.1\n1;2.5;20.4\n2;3.5;20.9\n"
STOOD = """axis = "Z"
at_mm = 120.0
[time]
column = "t min"
unit = "min"
[deviation]
column = "x um"
unit = "um"
[spindle_temperature]
column = "spindle"
unit = "C"
"""


def test_readings_over_time_of_an_axis_that_stood(folder: Folder) -> None:
    made = campaign_of([folder.read("d.csv", DRIFT, STOOD)], Answers(), "c", None)
    columns = made.folder.run_files[0]["columns"]
    assert (columns["t_s"], columns["z_mm"]) == ([0.0, 60.0, 120.0], [120.0] * 3)
    np.testing.assert_allclose(columns["deviation_mm"], [0, 0.0005, 0.0015])
    assert columns["temp_spindle_C"] == [20.1, 20.4, 20.9]
    evenly = STOOD.replace('[time]\ncolumn = "t min"\nunit = "min"\n', "").replace("at_mm", "every_s = 20.0\nat_mm")
    test = folder.read("d.csv", DRIFT, evenly).test
    assert test is not None
    assert test.t_s is not None
    assert test.t_s.tolist() == [0.0, 20.0, 40.0]
    neither = STOOD.replace("at_mm = 120.0\n", "")
    assert folder.refused("d.csv", DRIFT, neither).startswith("columns.toml: expected either target, or at_mm")


def workbook(path: Path, rows: list[list[str | float]]) -> None:
    """A workbook of one sheet, as any program may write it: inline strings, numbers."""
    cell = lambda r, v: f'<c r="{r}"><v>{v!r}</v></c>' if isinstance(v, float) else f'<c r="{r}" t="str"><v>{v}</v></c>'  # noqa: E731
    cells = ("".join(cell(f"{letter}{n}", v) for letter, v in zip("ABCD", row, strict=True)) for n, row in enumerate(rows, start=1))
    body = "".join(f'<row r="{n}">{row}</row>' for n, row in enumerate(cells, start=1))
    main = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    rel = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    package = "http://schemas.openxmlformats.org/package/2006"
    sheet = f"{package.replace('package/2006', 'officeDocument/2006')}/relationships/worksheet"
    document = sheet.removesuffix("worksheet") + "officeDocument"
    parts = {
        "_rels/.rels": f'<Relationships xmlns="{package}/relationships">'
        f'<Relationship Id="r0" Type="{document}" Target="xl/workbook.xml"/></Relationships>',
        "[Content_Types].xml": f'<Types xmlns="{package}/content-types"><Default Extension="xml" ContentType="application/xml"/></Types>',
        "xl/workbook.xml": f'<workbook xmlns="{main}" xmlns:r="{rel}"><sheets><sheet name="S" sheetId="1" r:id="r1"/></sheets></workbook>',
        "xl/_rels/workbook.xml.rels": f'<Relationships xmlns="{package}/relationships">'
        f'<Relationship Id="r1" Type="{sheet}" Target="worksheets/sheet1.xml"/></Relationships>',
        "xl/worksheets/sheet1.xml": f'<worksheet xmlns="{main}"><sheetData>{body}</sheetData></worksheet>',
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in parts.items():
            archive.writestr(name, text)


def test_an_excel_file_is_read_like_a_table(folder: Folder) -> None:
    rows: list[list[str | float]] = [[one.replace(",", ".") for one in line.split(";")] for line in TABLE.splitlines()[1:]]
    numbers = [rows[0], *[[float(a), float(b), c, float(d)] for a, b, c, d in rows[1:]]]  # type: ignore[arg-type]
    workbook(folder.path / "made.xlsx", numbers)  # type: ignore[arg-type]
    columns = COLUMNS.replace("heading = 2", "heading = 1")
    data = (folder.path / "made.xlsx").read_bytes()
    test = folder.read("t.xlsx", data, columns).test
    assert test is not None
    np.testing.assert_allclose(test.deviation * 1e3, [0, -5, -11, -8, -2.5, 3], atol=1e-9)
    assert folder.refused("t.xlsx", data, 'sheet = "Q"\n' + columns).startswith("t.xlsx:1: there is no sheet 'Q'; there are S")
    assert folder.refused("t.xlsx", data[:200], columns).startswith("t.xlsx:1: not an Excel workbook")


def test_a_column_file_comes_back_as_it_was(folder: Folder) -> None:
    (folder.path / "c.toml").write_text(COLUMNS)
    found = column_file(folder.path / "c.toml")
    (folder.path / "d.toml").write_text(toml_of(found))
    assert column_file(folder.path / "d.toml") == found


@pytest.mark.parametrize(
    ("text", "row"),
    [
        ("Target (mm);Error (um)\n0;0.1\n100;0.4\n", 1),
        ("Position error test, hall 3\nAir 20.1\n\nTarget (mm),Error (um)\n0,0.1\n", 4),
        ("Position error measured by John\nTarget;Deviation\n0;0.1\n", 2),
        ("0 0.1\n100 0.4\n", 1),
    ],
)
def test_the_row_of_the_headings_is_proposed_below_a_preamble(folder: Folder, text: str, row: int) -> None:
    for encoding in ("utf-8", "utf-16"):
        (folder.path / "t.csv").write_bytes(text.replace("\n", "\r\n").encode(encoding))
        assert likely_heading(folder.path / "t.csv") == row
