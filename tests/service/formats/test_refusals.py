"""What must be caught before a table is written or loaded: with file and line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from abbe.service.errors import FormatRefused, TableContradicts, TableFileError
from abbe.service.formats.compare import check_same
from abbe.service.formats.files import FormatSettings, TextFile
from abbe.service.formats.model import AxisTable, Compensation, Lattice
from abbe.service.formats.registry import FORMATS

P = np.array([0.0, 100.0, 200.0])
V = np.array([0.0, -0.010, 0.004])
GOOD = Compensation((AxisTable("X", "X", P, V, V - 0.003),))
TOLD = FormatSettings(reference_mm=(0.0, 0.0, 0.0))

KINEMATICS = "BEGIN X.COM MM\nNR AXISPOS C1 C2 C3 C4 C5 C6\n"
KINS = "COUNT[3] = {2, 2, 2};\nFIRST[3] = {0, 0, 0}, STEP[3] = {1, 1, 1};\nstatic const double TABLE[][3] = {\n"
CENTROID = "CNC10 TAB FILE VERSION 3\nAXIS X\nUNITS MM\nINTERVAL 25\nENTRIES 3\n"
MACH4 = "axis,X\nstart_mm,0\nlength_mm,10\npoints,3\npoint,position_mm,error_plus_mm,error_minus_mm\n"
BAD_FILES = [
    ("linuxcnc-1", "x.comp", "# made by hand\n0 0 0\n100 0.01 0.01\n", r"x\.comp:1: .*would stop reading here"),
    ("linuxcnc-1", "x.comp", "0 0 0\n\n100 0.01 0.01\n", r"x\.comp:2: the line is blank"),
    ("linuxcnc-1", "x.comp", "0 0 0\n100,0.01,0.01\n", r"x\.comp:2: "),
    ("linuxcnc-1", "x.comp", "0 0 0\n100 0.01 0.01\n50 0.02 0.02\n", r"x\.comp:3: position 50 after 100"),
    ("linuxcnc-1", "x.comp", "0 0 0\n100 0.01 0.01\n100 0.02 0.02\n", r"x\.comp:3: position 100 after 100"),
    ("linuxcnc-1", "x.comp", "0 0 0\n100 nan 0.01\n", r"x\.comp:2: forward is 'nan'"),
    ("linuxcnc-1", "x.comp", "0 0 0\n100 100.01 100.01\n", r"x\.comp:2: .*looks like type 0"),
    ("linuxcnc-0", "x.comp", "0 0 0\n100 0.01 0.01\n", r"x\.comp:2: .*looks like type 1"),
    ("linuxcnc-1", "x.comp", "".join(f"{k} 0 0\n" for k in range(300)), r"x\.comp:257: 300 points: LinuxCNC takes 256"),
    ("linuxcnc-1", "x.comp", "", "empty"),
    ("linuxcnc-hal", "abbe.hal", "loadrt lincurve names=t-xx personality=2\nsetp t-xx.x-val-00 0\n", "y-val-00 is not set"),
    ("siemens-eec", "AX_EEC.INI", "%_N_AX_EEC_INI\nCHANDATA(1)\n$AA_ENC_COMP[0,0,X1]=0.0\n", "M17 is missing"),
    ("siemens-eec", "AX_EEC.INI", "%_N_AX_EEC_INI\n$AA_ENC_COMP[0,0,X1]=0.0\n$AA_ENC_COMP[0,2,X1]=0.0\nM17\n", "point 1 is missing"),
    ("siemens-cec", "NC_CEC.INI", "%_N_AX_EEC_INI\nM17\n", r"INI:1: the file is %_N_AX_EEC_INI"),
    ("fanuc-pitch", "P.TXT", "%\nN03620Q1A1P0\nN10000Q1P1\n", "cut off"),
    ("fanuc-pitch", "P.TXT", "%\nN10000Q1P1.5\n%\n", r"P\.TXT:2: "),
    ("heidenhain", "X.COM", "BEGIN X.COM MM\nNR AXISPOS X\n0 0 0\n1 0 0\n[END]\n", r"X\.COM:4: position 0 after 0"),
    ("heidenhain", "X.COM", "BEGIN X.COM MM\nNR AXISPOS X\n0 0 0\n", "cut off"),
    ("heidenhain-kinematics", "X.COM", "BEGIN X.COM MM\nNR AXISPOS X\n0 0 0\n1 9 0\n[END]\n", r"X\.COM:2: columns"),
    ("heidenhain-kinematics", "X.COM", KINEMATICS + "0 0 0 0 0 0 0 0\n1 9 0 0\n[END]\n", r"X\.COM:4: 4 values for 8"),
    ("linuxcnc-kins", "abbekins.c", "int main() {}\n", "COUNT, FIRST and STEP"),
    ("linuxcnc-kins", "abbekins.c", KINS + "    {0, 0, 0},\n};\n", "1 nodes, 2 x 2 x 2 stated"),
    ("linuxcnc-kins", "abbekins.c", KINS + "    {0, 0},\n};\n", r"abbekins\.c:4: .*three numbers"),
    ("mach4", "m.csv", MACH4 + "1,0,0,0\n2,9,0,0\n", r"m\.csv:7"),
    ("mach4", "m.csv", MACH4 + "1,0,0,0\n2,5,0,0\n", "2 points, but the heading states 3: the file is cut off"),
    ("mach4", "m.csv", MACH4 + "1,0,0,0\n2,5,0,0\n3,10,0,0\n4,15,0,0\n", "4 points, but the heading states 3 -"),
    ("centroid", "cnc-x.tab", "3 1000\n0\n1\n", r"cnc-x\.tab:1: the first line is '3 1000'"),
    ("centroid", "cnc-x.tab", CENTROID + "0\t0\t0\n25\t0\t0\n", "2 entries, 3 stated"),
    ("centroid", "cnc-x.tab", CENTROID + "0\t0\t0\n25\t0\t0\n75\t0\t0\n", r"cnc-x\.tab:8: position 75 after 25"),
    ("centroid", "cnc-x.tab", CENTROID.replace("MM", "INCH"), r"cnc-x\.tab:3: axis X, units INCH"),
    ("marlin", "a.gcode", "M852 I0.001\nM206 X1\n", r"a\.gcode:2: M206 is neither"),
    ("marlin", "a.gcode", "M852 I0.001 K1e\n", r"a\.gcode:1: K is '1e'"),
    ("marlin", "a.gcode", "M425 X0.01 F0.5\n", r"a\.gcode:1: F0\.5 corrects only a part"),
    ("klipper", "a.gcode", "SET_SKEW XY=140.4,142.8\n", r"a\.gcode:1: .* three lengths"),
    ("klipper", "a.gcode", "SET_SKEW XY=1,1,99\n", r"a\.gcode:1: .*no parallelogram"),
    ("grblhal", "a.txt", "$100=0.1\n", r"a\.txt:1: \$100 is neither"),
    ("fanuc-lattice", "l.csv", "x,y,z\n", r"l\.csv:1: the heading"),
    ("isg", "v.csv", "X EXX\n0 0\n10 0.1\n5 0.2\n", r"v\.csv:4: position 5 after 10"),
    ("isg", "v.csv", "X EXX EYY\n0 0 0\n", r"v\.csv:1: EYY is not an error motion of X"),
]


@pytest.mark.parametrize(("key", "name", "text", "said"), BAD_FILES)
def test_bad_file_is_named_with_its_line(key: str, name: str, text: str, said: str) -> None:
    from tests.service.formats.proof import SETTINGS

    with pytest.raises(TableFileError, match=said):
        FORMATS[key].read((TextFile(name, text),), SETTINGS)


def _table(position: np.ndarray, values: np.ndarray) -> Compensation:
    return Compensation((AxisTable("X", "X", position, values, values),))


TOO_MANY = np.arange(300.0)
REFUSED = [
    ("linuxcnc-1", _table(TOO_MANY, np.zeros(300)), TOLD, "300 points, the control holds 2 to 256"),
    ("linuxcnc-hal", _table(np.arange(17.0), np.zeros(17)), TOLD, "2 to 16"),
    ("linuxcnc-hal", GOOD, TOLD, "holds only one column"),
    ("siemens-eec", GOOD, TOLD, "holds only one column"),
    ("siemens-eec", _table(np.array([0.0, 1.0, 3.0]), np.zeros(3)), TOLD, "equal distances"),
    ("siemens-eec", _table(P, V), replace(TOLD, points=2), "holds 2 to 2"),
    ("siemens-eec", _table(P, V + 0.001), TOLD, r"\+1\.000 µm at the reference"),
    ("linuxcnc-1", _table(P, V + 0.001), TOLD, "where it must be zero"),
    ("linuxcnc-1", _table(P[::-1], V), TOLD, "do not increase"),
    ("linuxcnc-1", _table(P, np.array([0.0, np.nan, 0.0])), TOLD, "not numbers"),
    ("linuxcnc-1", _table(P, 1000.0 * V), TOLD, "the largest allowed is 1 mm"),
    ("linuxcnc-1", Compensation((AxisTable("X", "Y", P, V, V),)), TOLD, "cannot hold the table Y over X"),
    ("fanuc-pitch", _table(P, 30.0 * V), TOLD, "the control holds ±127"),
    ("fanuc-pitch", _table(P, V), replace(TOLD, reference_mm=(50.0, 0.0, 0.0)), "µm at the reference|no point at the reference"),
    ("fanuc-pitch", _table(P, V), replace(TOLD, first_point=1023), "the control has 0 to 1023"),
    ("heidenhain", _table(P, V), replace(TOLD, power_of_two=True), "power of two"),
    ("centroid", _table(P, V - V[1]), replace(TOLD, reference_mm=(100.0, 0.0, 0.0)), "neither end"),
    ("mach4", Compensation(), TOLD, "nothing to write"),
    ("fanuc-lattice", Compensation(lattice=Lattice((P, P, np.array([0.0, 1.0, 5.0])), np.zeros((3, 3, 3, 3)))), TOLD, "equal distances"),
    ("marlin", Compensation((AxisTable("Y", "X", P, V, V),)), TOLD, "can hold only straight lines"),
    ("marlin", Compensation((AxisTable("X", "Y", P, P * 1e-5, P * 1e-5),)), TOLD, "only straight lines"),
    ("marlin", Compensation(lost_motion_mm={"X": -0.001}), TOLD, "expected 0 or more"),
    ("klipper", Compensation(lost_motion_mm={"X": 0.001}), TOLD, "cannot hold a backlash parameter"),
    ("grblhal", Compensation((AxisTable("Y", "X", P[:2], V[:2], V[:2]),)), TOLD, "cannot hold the table"),
    ("isg", Compensation(lattice=Lattice((P, P, P), np.zeros((3, 3, 3, 3)))), TOLD, "cannot hold a 3-D grid"),
]


@pytest.mark.parametrize(("key", "comp", "told", "said"), REFUSED)
def test_what_does_not_fit_is_not_written(key: str, comp: Compensation, told: FormatSettings, said: str) -> None:
    with pytest.raises(FormatRefused, match=said):
        FORMATS[key].write(comp, told)


def _times(factor: float) -> Compensation:
    return Compensation(tuple(replace(t, forward_mm=factor * t.forward_mm, backward_mm=factor * t.backward_mm) for t in GOOD.tables))


MISTAKES = [
    (_times(-1.0), "the sign is wrong"),
    (_times(1000.0), "µm were taken for mm"),
    (_times(1e-3), "mm were taken for µm"),
    (_times(25.4), "mm were taken for inches"),
    (Compensation((replace(GOOD.tables[0], forward_mm=V - 0.003, backward_mm=V),)), "directions are exchanged"),
    (Compensation((replace(GOOD.tables[0], axis="Y", output="Y"),)), "tables of X and Y are exchanged"),
    (_times(1.3), "not the expected ones"),
]


@pytest.mark.parametrize(("found", "said"), MISTAKES)
def test_mistakes_that_only_the_expected_table_shows(found: Compensation, said: str) -> None:
    with pytest.raises(TableContradicts, match=said):
        check_same(found, GOOD, 1e-6)


def test_a_file_of_the_other_convention_is_caught_against_the_expected_table() -> None:
    """The same numbers under the other sign: what a Siemens file means when somebody writes −e into it."""
    plain = _table(P, V)
    file = FORMATS["siemens-eec"].write(_table(P, -V), TOLD)
    with pytest.raises(TableContradicts, match="the sign is wrong: this file would double every error"):
        check_same(FORMATS["siemens-eec"].read(file, TOLD), plain, 1e-6)
    assert max(d.size_mm for d in check_same(plain, plain, 1e-9)) == 0.0
