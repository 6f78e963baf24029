"""What documents and a real control say, against what the formats write and what the model does with it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from abbe.models.arrays import F1, F2
from abbe.service.errors import FormatRefused, TableFileError
from abbe.service.formats import skew
from abbe.service.formats.files import FormatSettings, TextFile
from abbe.service.formats.model import AxisCurve, AxisTable, Compensation, Lattice, Motions, ProductTable, correction_at
from abbe.service.formats.registry import FORMATS
from tests.service.formats.page import PAGE, page
from tests.service.formats.proof import SETTINGS, all_proofs

# controllers.md 5.7, by hand: what +10 µm of error at 100 mm must be in each file.
STEP = {
    ("isg", "X over X"): "100.0 0.01",
    ("linuxcnc-1", "X over X"): "100 -0.0100 -0.0100",
    ("linuxcnc-0", "X over X"): "100 100.0100 100.0100",
    ("linuxcnc-1", "X over X, only while moving in −"): "100 0.0000 -0.0100",
    ("linuxcnc-hal", "Y over X"): "setp t-yx.y-val-02 -0.01",
    ("siemens-eec", "X over X"): "$AA_ENC_COMP[0,2,X1]=0.01",
    ("siemens-cec", "Y over X"): "$AN_CEC[0,2]=-0.01",
    ("fanuc-pitch", "X over X"): "N10001Q1P-10",
    ("fanuc-lattice", "3-D grid, X"): "14,100,100,100,-10,0,0",
    ("mach4", "X over X"): "3,100.0,-0.0100,-0.0100",
    ("centroid", "X over X"): "100\t-0.01\t-0.01",
    ("heidenhain-kinematics", "EYX"): "2    100.0000     0.0000        0.0100        0.0000        0.0000000     0.0000000     0.0000000",
    ("linuxcnc-kins", "3-D grid, X"): "    {-0.01, 0, 0},",
    ("marlin", "X over Y, 100 µrad"): "M852 I0.00010000000 J0.00000000000 K0.00000000000",
    ("grblhal", "lost motion of X"): "$160=0.0100",
}


def test_step_stands_in_every_file_as_the_specification_says() -> None:
    found = {(p.format, p.what): p for p in all_proofs()}
    assert {f for f, _ in found} == set(FORMATS)
    for key, line in STEP.items():
        assert line in found[key].lines, key
    for proof in found.values():
        assert proof.lines
        # An angle in degrees is rounded to 1e-7, and acts at a lever of 200 mm.
        rounding = 0.5 * np.radians(1e-7) * 200.0 if "EBX" in proof.what else 1e-9
        assert proof.added_mm == pytest.approx(-0.010, abs=rounding), proof


def test_page_is_current() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run python -m tests.service.formats.page"


def _added(comp: Compensation, x: float, way: int, axis: int = 0) -> float:
    at, direction = np.zeros((1, 3)), np.full((1, 3), float(way))
    at[0, axis] = x
    return float(correction_at(comp, at, direction)[0, axis])


def test_comp_files_do_what_linuxcnc_was_seen_to_do(shared: Path) -> None:
    """controllers.md 1.4: motor minus commanded position, read from the running control."""
    folder = shared / "examples" / "linuxcnc"
    x = FORMATS["linuxcnc-1"].read((TextFile("x.comp", (folder / "x.comp").read_text()),), FormatSettings())
    seen = ((50, 1, 0.0050), (150, 1, 0.0175), (250, 1, 0.0200), (250, -1, 0.0215), (333, 1, 0.0084), (450, 1, -0.0125), (450, -1, -0.0110))
    for at, way, added in seen:
        assert _added(x, at, way) == pytest.approx(added, abs=2e-6), (at, way)
    z = FORMATS["linuxcnc-0"].read((TextFile("z.comp", (folder / "z.comp").read_text()),), FormatSettings())
    assert _added(z, -100, -1, axis=2) == pytest.approx(-0.0120, abs=1e-9)
    assert _added(z, -125, 1, axis=2) == pytest.approx(-0.00375, abs=1e-9)


@pytest.mark.parametrize("name", ["x.comp", "y.comp"])
def test_comp_files_come_back_byte_for_byte(shared: Path, name: str) -> None:
    text = (shared / "examples" / "linuxcnc" / name).read_text()
    form = FORMATS["linuxcnc-1"]
    settings = FormatSettings(decimals=3)
    assert form.write(form.read((TextFile(name, text),), settings), settings) == (TextFile(name, text),)


def test_hal_network_does_what_linuxcnc_was_seen_to_do() -> None:
    """controllers.md 1.5: drive minus motor command of the tried network (voltest.py), written and read in our form."""
    p = 50.0 * np.arange(11)
    tables = (
        AxisTable("Y", "X", p, *[0.008 * np.sin(p / 400 * np.pi)] * 2),
        AxisTable("X", "Y", p, *[0.012 * (p / 500) ** 2 + 50e-6 * p] * 2),
        AxisTable("X", "Z", p, *[-0.006 * p / 500] * 2),
    )
    product = ProductTable("Z", AxisCurve("Y", p, 20e-6 * p / 400), AxisCurve("Y", np.array([0.0, 500.0]), np.array([0.0, 500.0])))
    form, settings = FORMATS["linuxcnc-hal"], FormatSettings(decimals=9)
    comp = form.read(form.write(Compensation(tables, (product,)), settings), settings)
    at = np.array([[100, 200, -100], [250, 100, -50], [500, 400, -300]], dtype=float)
    seen = [[0.008000, 0.005480, 0.000800], [0.005657, 0.015500, -0.002500], [0.000000, 0.037000, 0.002000]]
    np.testing.assert_allclose(correction_at(comp, at), seen, atol=1.5e-6)


EEC_HEAD = """%_N_AX_EEC_INI
CHANDATA(1)
$AA_ENC_COMP[0,0,X1]=0.003
$AA_ENC_COMP[0,1,X1]=0.01
$AA_ENC_COMP[0,2,X1]=0.012
"""
EEC_TAIL = """$AA_ENC_COMP[0,800,X1]=0.0
$AA_ENC_COMP_STEP[0,X1]=1.0
$AA_ENC_COMP_MIN[0,X1]=-200.0
$AA_ENC_COMP_MAX[0,X1]=600.0
$AA_ENC_COMP_IS_MODULO[0,X1]=0
M17
"""


def test_siemens_encoder_example_comes_out_byte_for_byte() -> None:
    """6FC5397-1BP40-3BA1 p. 242, without its comments and its minus before the last zero: +3 µm at -200 mm moves the axis in −."""
    value = np.zeros(801)
    value[:3] = [-0.003, -0.010, -0.012]
    table = AxisTable("X", "X", -200.0 + np.arange(801), value, value)
    text = FORMATS["siemens-eec"].write(Compensation((table,)), FormatSettings())[0].text
    assert text.startswith(EEC_HEAD)
    assert text.endswith(EEC_TAIL)
    middle = text[len(EEC_HEAD) : -len(EEC_TAIL)].splitlines()
    assert middle == [f"$AA_ENC_COMP[0,{k},X1]=0.0" for k in range(3, 800)]


CEC = """%_N_NC_CEC_INI
CHANDATA(1)
$AN_CEC[0,0]=0.0
$AN_CEC[0,1]=0.01
$AN_CEC[0,2]=0.012
$AN_CEC_INPUT_AXIS[0]=(AX2)
$AN_CEC_OUTPUT_AXIS[0]=(AX1)
$AN_CEC_STEP[0]=8.0
$AN_CEC_MIN[0]=-400.0
$AN_CEC_MAX[0]=-384.0
$AN_CEC_DIRECTION[0]=0
$AN_CEC_MULT_BY_TABLE[0]=0
$AN_CEC_IS_MODULO[0]=0
M17
"""


def test_siemens_cross_example_comes_back_byte_for_byte() -> None:
    """The variables of 6FC5397-1CP10-5BA0 p. 222 in their order (its own step of 6.73 mm does not divide its range: shortened here)."""
    form = FORMATS["siemens-cec"]
    comp = form.read((TextFile("NC_CEC.INI", CEC),), FormatSettings())
    assert (comp.tables[0].axis, comp.tables[0].output) == ("Y", "X")
    assert form.write(comp, FormatSettings())[0].text == CEC


def test_fanuc_example_sums_up_as_drawn() -> None:
    """B-63980EN p. 100: points 33 to 49, reference at point 40; the sum at the reference is zero and the numbers come back."""
    numbers = [2, 1, 1, -2, 0, -1, 0, -1, 2, 1, 0, -1, -1, -2, 0, 1, 2]
    head = ["%", "N03620Q1A1P40", "N03621Q1A1P33", "N03622Q1A1P49", "N03623Q1A1P1", "N03624Q1A1P50.0"]
    text = "\n".join([*head, *(f"N{10033 + k}Q1P{v}" for k, v in enumerate(numbers)), "%"]) + "\n"
    settings = FormatSettings(reference_mm=(0.0, 0.0, 0.0), first_point=33)
    form = FORMATS["fanuc-pitch"]
    comp = form.read((TextFile("PITCH.TXT", text),), settings)
    assert comp.tables[0].position_mm[0] == -400.0
    assert _added(comp, 0.0, 1) == 0.0
    assert _added(comp, -400.0, 1) == pytest.approx(0.0, abs=1e-12)  # +2+1+1-2+0-1+0-1 = 0
    assert _added(comp, -350.0, 1) == pytest.approx(0.002)
    assert _added(comp, 50.0, 1) == pytest.approx(0.002)
    assert form.write(comp, settings)[0].text == text


FANUC_ROTARY = """%
N03620Q1A4P10000
N03621Q1A4P10000
N03622Q1A4P10004
N03623Q1A4P1
N03624Q1A4P90000
N03625Q1A4P360000
N10001Q1P-1
N10002Q1P-1
N10003Q1P1
%
"""


LINEAR = """%
N03620Q1A1P0
N03621Q1A1P1
N03622Q1A1P3
N03623Q1A1P1
N03624Q1A1P90000
N10001Q1P-1
N10002Q1P-1
N10003Q1P1
%
"""


def test_fanuc_vector_of_a_rotary_table_has_our_increments_and_is_refused_as_a_table_of_x() -> None:
    """formats-fields.md: errors 0, 3.6, 7.2, 3.6 arcsec in units of 0.001 deg are -1, -1, +1; here µm over 0, 90, 180, 270 mm."""
    value = -1e-3 * np.array([0.0, 1.0, 2.0, 1.0])
    form, settings = FORMATS["fanuc-pitch"], FormatSettings(reference_mm=(0.0, 0.0, 0.0), first_point=1)
    text = form.write(Compensation((AxisTable("X", "X", 90.0 * np.arange(4), value, value),)), settings)[0].text
    assert [line for line in text.splitlines() if line.startswith("N1")] == [line for line in FANUC_ROTARY.splitlines() if "N1000" in line]
    linear = FORMATS["fanuc-pitch"].read((TextFile("P.PRM", LINEAR),), settings).tables[0]
    assert linear.position_mm.tolist() == [0.0, 90.0, 180.0, 270.0]  # 90000 without a point is 90
    with pytest.raises(TableFileError, match=r"P\.PRM:3: axis A4, expected A1 to A3"):
        form.read((TextFile("P.PRM", FANUC_ROTARY),), settings)


def test_siemens_files_of_a_public_tool_are_read() -> None:
    """formats-fields.md: blanks around "=", signs, AX3 for the axis, and the measured error with its own sign."""
    lines = ["$AA_ENC_COMP[0,0,AX3] = +0.0", "$AA_ENC_COMP[0,1,AX3] = +0.0012", "$AA_ENC_COMP_STEP[0,AX3] = 50.0"]
    lines += ["$AA_ENC_COMP_MIN[0,AX3] = 0.0", "$AA_ENC_COMP_MAX[0,AX3] = 50.0", "$AA_ENC_COMP_IS_MODULO[0,AX3]  = 0"]
    text = "\n".join(["%_N_AX_EEC_INI", "CHANDATA(1)", *lines, "M17"]) + "\n"
    comp = FORMATS["siemens-eec"].read((TextFile("AX3.INI", text),), FormatSettings(axis_names=("AX1", "AX2", "AX3")))
    assert (comp.tables[0].axis, comp.tables[0].forward_mm.tolist()) == ("Z", [0.0, -0.0012])


@pytest.mark.parametrize(
    ("name", "head"),
    [
        ("AXIS-X.COM", "BEGIN AXIS-X.COM  DATUM:+0.0000 DISTANCE:+50.0000\nNR   X\n"),
        ("AXIS_X.COM", "BEGIN AXIS_X.COM MM\nNR   AXISPOS       X\n"),
    ],
)
def test_heidenhain_headings_of_two_controls_are_read(name: str, head: str) -> None:
    """formats-fields.md: iTNC 530 states datum and distance, TNC 640 has a column of positions."""
    positions = ["", "", ""] if "DATUM" in head else ["-0.0000 ", "50.0000 ", "100.0000 "]
    rows = "".join(f"{k}  {p}{v}\n" for k, (p, v) in enumerate(zip(positions, ("0.0000", "-0.0100", "0.0020"), strict=True)))
    comp = FORMATS["heidenhain"].read((TextFile(name, f"{head}{rows}[END]\n"),), SETTINGS)
    assert (comp.tables[0].axis, comp.tables[0].position_mm.tolist()) == ("X", [0.0, 50.0, 100.0])
    assert comp.tables[0].forward_mm.tolist() == [0.0, -0.010, 0.002]


CENTROID = """CNC10 TAB FILE VERSION 3
AXIS X
UNITS MM
INTERVAL 25
ENTRIES 10
"""


def test_centroid_file_of_a_control_comes_back_byte_for_byte() -> None:
    """cnc-x.tab of github.com/teno1608/PLC-CNC-lathe-machine: ten entries of zeros, from the reference in −."""
    text = CENTROID + "".join(f"{-25 * k}\t0\t0\n" for k in range(10))
    settings = FormatSettings(reference_mm=(0.0, 0.0, 0.0))
    form = FORMATS["centroid"]
    comp = form.read((TextFile("cnc-x.tab", text),), settings)
    assert comp.tables[0].position_mm.tolist() == [25.0 * k for k in range(-9, 1)]
    assert form.write(comp, settings)[0].text == text


def test_skew_factor_of_marlin_and_klipper() -> None:
    """formats-fields.md: AC 140.4, BD 142.8, AD 99.8 give AB 100.4587477525 and XY -0.0169507368."""
    factor = skew.factor_of(140.4, 142.8, 99.8)
    assert factor == pytest.approx(-0.0169507368, abs=1e-9)
    assert skew.factor_of(*skew.lengths_of(factor)) == pytest.approx(factor, abs=1e-12)
    square = skew.lengths_of(0.0)
    assert square == pytest.approx((141.4213562373, 141.4213562373, 100.0), abs=1e-9)


@pytest.mark.parametrize(("key", "command"), [("marlin", "M852 I-0.0169507368"), ("klipper", "SET_SKEW XY=140.4,142.8,99.8")])
def test_a_skew_that_was_measured_moves_x_as_the_programs_do(key: str, command: str) -> None:
    """x - y factor: with the factor of the vector, Y 100 moves X by +1.69507 mm."""
    comp = FORMATS[key].read((TextFile("a.gcode", command + "\n"),), SETTINGS)
    assert correction_at(comp, np.array([[0.0, 100.0, 0.0]]))[0] == pytest.approx([1.69507368, 0.0, 0.0], abs=1e-7)


def test_heidenhain_kinematics_are_the_motions_of_the_manual_with_squareness() -> None:
    """iTNC 530 HSCI p. 680: C1 to C6 are EXX EYX EZX EAX EBX ECX; squareness C0Y of 100 µrad is a line of EXY, -0.1 mm a metre."""
    p = np.array([0.0, 100.0, 200.0])
    names = ("EXX", "EYX", "EZX", "EAX", "EBX", "ECX")
    curves = {n: AxisCurve("X", p, np.array([0.0, 1.0, 0.0]) * (0.001 * (k + 1) if k < 3 else 1e-5 * k)) for k, n in enumerate(names)}
    assert SETTINGS.machine is not None
    files = FORMATS["heidenhain-kinematics"].write(Compensation(motions=Motions(SETTINGS.machine, curves, {"C0Y": 1e-4})), SETTINGS)
    text = {f.name: [line.split() for line in f.text.splitlines()] for f in files}
    assert text["X.COM"][1] == ["NR", "AXISPOS", "C1", "C2", "C3", "C4", "C5", "C6"]
    degrees = [f"{np.degrees(1e-5 * k):.7f}" for k in (3, 4, 5)]
    assert text["X.COM"][3] == ["1", "100.0000", "0.0010", "0.0020", "0.0030", *degrees]
    assert text["Y.COM"][-2][:3] == ["1", "200.0000", "-0.0200"]
    assert "Z.COM" not in text


ISG = """// component errors of the X axis
X EXX EYX EZX EAX EBX ECX
0.0 0.02 0.01 0.07 0.00 0.0042 0.003
10.0 0.00 -0.1 0.01 0.00 0.0011 0.002
"""


def test_the_polynomial_of_a_real_gantry_is_held_at_the_nodes_and_bounded_between_them(shared: Path) -> None:
    """calibxyzkins of a 5.3 m machine: position A j + B j² + C. Its errors of 60 mm are refused; a hundredth of them is held."""
    text = (shared / "data" / "foreign" / "linuxcnc-gantry" / "calibrations_params_used.md").read_text()
    a, b, c = (np.array(json.loads(m)) for m in re.findall(r"array\((\[\[.*?\]\])\)", text, re.S))

    def error_mm(joints: F2) -> F2:
        return np.asarray(joints @ (a - np.eye(3)).T + joints**2 @ b.T + c.T) / 100.0

    def lattice(grids: tuple[F1, F1, F1], scale: float) -> Compensation:
        nodes = np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1)
        return Compensation(lattice=Lattice(grids, -scale * error_mm(nodes.reshape(-1, 3)).reshape(nodes.shape)))

    grids = tuple(np.linspace(0.0, length, n) for length, n in ((5300.0, 11), (5200.0, 11), (1000.0, 3)))
    kins, exact = FORMATS["linuxcnc-kins"], FormatSettings(decimals=9)
    with pytest.raises(FormatRefused, match="the largest allowed is 1 mm"):
        kins.write(lattice(grids, 100.0), exact)
    held = kins.read(kins.write(lattice(grids, 1.0), exact), exact)
    nodes = np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1).reshape(-1, 3)
    between = nodes[(nodes < [5300.0, 5200.0, 1000.0]).all(axis=1)] + np.array([265.0, 260.0, 250.0])
    still = np.ones((1, 3))
    assert np.abs(correction_at(held, nodes, still) + error_mm(nodes)).max() < 1e-9
    bend = np.abs(b).max(axis=0) / 100.0 @ (np.array([530.0, 520.0, 500.0]) ** 2 / 4.0)
    assert np.abs(correction_at(held, between, still) + error_mm(between)).max() < bend


def test_isg_example_is_read_number_by_number() -> None:
    """Page 296429067. Its numbers have no one way of writing (0.02, 0.00): it comes back equal in value, not in bytes."""
    form = FORMATS["isg"]
    comp = form.read((TextFile("volcomp.csv", ISG),), SETTINGS)
    assert comp.motions is not None
    assert comp.motions.curves["EYX"].value.tolist() == [0.01, -0.1]
    assert comp.motions.curves["EBX"].value.tolist() == [0.0042, 0.0011]
    again = form.write(comp, SETTINGS)[0].text.splitlines()[1:]
    for line, original in zip(again[1:], ISG.splitlines()[2:], strict=True):
        assert [float(w) for w in line.split()] == [float(w) for w in original.split()]
    assert again[0] == ISG.splitlines()[1]
