"""Renishaw .rtl and .rta: every reading with its side and unit, or one line that names file, line and mistake."""

from __future__ import annotations

import numpy as np
import pytest

from abbe.service.errors import FileFormatError
from abbe.service.instrument_files.content import Content
from abbe.service.instrument_files.registry import READERS
from tests.service.instrument_files.examples import ENVIRONMENT, renishaw


def read(text: str | bytes, name: str = "x.rtl") -> Content:
    return READERS[name[-4:]](name, text if isinstance(text, bytes) else text.encode())


def test_the_vector_of_the_format() -> None:
    found = read(renishaw())
    test = found.test
    assert test is not None
    assert (found.machine, test.axis, test.quantity, test.resolution) == ("VMC-1", "X", "length", pytest.approx(1e-4))
    assert test.position_mm.tolist() == [0, 100, 200, 200, 100, 0] * 2
    assert test.direction.tolist() == [1, 1, 1, -1, -1, -1] * 2
    np.testing.assert_allclose(test.deviation * 1e3, [0, -5, -11, -8, -2.5, 3] * 2)
    assert test.further == {}
    assert found.notes == ()


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_line_ends_do_not_matter(end: str) -> None:
    one, other = (read(text).test for text in (renishaw(), renishaw().replace("\n", end)))
    assert one is not None
    assert other is not None
    assert one.deviation.tolist() == other.deviation.tolist()


def test_a_negative_first_target_is_read() -> None:
    """A public reader takes a line as data only if it begins with a digit."""
    test = read(renishaw(targets=(-10, 0, 10), runs=[(1, 2, 3), (4, 5, 6)])).test
    assert test is not None
    assert test.position_mm.tolist() == [-10, 0, 10, 10, 0, -10]


def test_targets_that_fall_are_a_way_in_minus() -> None:
    test = read(renishaw(targets=(0, -100, -200), runs=[(1, 2, 3), (4, 5, 6)])).test
    assert test is not None
    assert test.direction.tolist() == [-1, -1, -1, 1, 1, 1]


def test_zeros_on_the_way_back_of_a_one_way_test_are_no_readings() -> None:
    text = renishaw(runs=[(1, 2, 3), (0, 0, 0), (4, 5, 6), (0, 0, 0)])
    found = read(text.replace("Flags: 0 0", "Flags: 0 1"))
    assert found.test is not None
    np.testing.assert_allclose(found.test.deviation * 1e3, [1, 2, 3, 4, 5, 6])
    assert (found.test.direction == 1).all()
    assert "2 runs back hold only zeros" in found.notes[0]


def test_temperatures_of_the_file_become_columns() -> None:
    found = read(renishaw(environment=ENVIRONMENT))
    assert found.test is not None
    further = found.test.further
    assert set(further) == {"temp_air_C", "temp_x_C", "pressure_air_Pa"}
    np.testing.assert_allclose(further["temp_x_C"][[0, -1]], [21.1, 21.5])
    np.testing.assert_allclose(further["pressure_air_Pa"][[0, -1]], [101210, 101230])
    assert found.notes == ("Mat temp 3 (line 46) is zero, or not from -20 to 50: it was not used",)
    assert found.said["Air humid"] == "45 45 46"


def test_angles_are_milliradian() -> None:
    test = read(renishaw(kind="rta", runs=[(0.001, 0.002, 0.004), (0.001, 0.003, 0.004)]), "x.rta").test
    assert test is not None
    assert test.quantity == "angle"
    np.testing.assert_allclose(test.deviation, [1e-6, 2e-6, 4e-6, 4e-6, 3e-6, 1e-6])


@pytest.mark.parametrize(("encoding", "name"), [("utf-8", "Fräse 1"), ("utf-16", "Fräse 1"), ("latin-1", "Größe 1"), ("gbk", "立式镗床")])
def test_names_in_the_encodings_that_occur(encoding: str, name: str) -> None:
    assert read(renishaw(user=f"Machine:{name}\nAxis:X").encode(encoding)).machine == name


GOOD = renishaw()
WRONG = {
    "cut off": (GOOD[: GOOD.index("4   2")], "x.rtl:36: section EOF:: is missing"),
    "a row too few": (GOOD.replace("4   1      3.0\n", ""), "x.rtl:37: the file ends after 11 of 12 deviations"),
    "a row too many": (GOOD.replace("\n\nEOF", "\n5   1      3.0\n\nEOF"), "x.rtl:39: more rows than 4 runs of 3 targets"),
    "rows exchanged": (GOOD.replace("1   2 ", "1   3 ", 1), "x.rtl:28: run 1, target 3, expected run 1, target 2"),
    "run forgotten": (GOOD.replace("2   3 ", "3   3 "), "x.rtl:30: run 3, target 3, expected run 2, target 3"),
    "decimal comma": (GOOD.replace("-2.5", "-2,5", 1), "x.rtl:31: the deviation is '-2,5', expected a number"),
    "not a number": (GOOD.replace("-8.0", "nan", 1), "x.rtl:30: the deviation is 'nan', expected a number"),
    "infinite": (GOOD.replace("-8.0", "1e999", 1), "x.rtl:30: the deviation is '1e999', expected a number"),
    "digits of another script": (GOOD.replace("-8.0", "٨.0", 1), "x.rtl:30: the deviation is '٨.0', expected a number"),
    "a value too few": (GOOD.replace("1   1      0.0", "1   0.0", 1), "x.rtl:27: 2 values, expected run, target and deviation"),
    "targets fewer than counted": (GOOD.replace("100.0000  ", ""), "x.rtl:6: 2 targets, Target-count says 3"),
    "targets go back": (GOOD.replace("100.0000", "300.0000"), "x.rtl:6: expected two or more targets, all rising or all falling"),
    "unknown flags": (GOOD.replace("0 0 2 0", "0 0 1 0"), "x.rtl:11: Flags '0 0 1 0' are not known"),
    "flags contradict the rows": (GOOD.replace("0 0 2 0", "0 1 2 0"), "x.rtl:30: run 2 is read back, but the flags say one direction"),
    "an odd run": (GOOD.replace("Run-count:4", "Run-count:3"), "x.rtl:23: Run-count is 3: a test in both directions has an even number"),
    "another kind": (GOOD.replace(": rtl", ": rts"), "x.rtl:1: the file type is 'rts', expected rtl or rta"),
    "kind and owner differ": (GOOD.replace(": Linear", ": Angular"), "x.rtl:1: the owner is 'Angular', expected 'linear' in a .rtl"),
    "section twice": (GOOD + "RUNS::\nRun-count:4\n", "x.rtl:41: a second section RUNS:: (the first is in line 22)"),
    "two axes": (GOOD.replace("By:a", "Axis:Y"), "x.rtl:18: a second Axis: 'Y' before, 'X' here"),
    "another unit": (GOOD.replace("-11.0", "-1100000.0", 1), "x.rtl:29: the deviation is -1.1e+06 µm, more than the targets are apart"),
    "no section": ("hello\n", "x.rtl:1: 'hello' is outside of every section"),
    "binary": (GOOD.replace("VMC-1", "VMC\0"), "x.rtl:14: it holds the character '\\x00'"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_is_one_line_with_its_number(wrong: str) -> None:
    text, message = WRONG[wrong]
    with pytest.raises(FileFormatError) as refused:
        read(text)
    assert str(refused.value).startswith(message), str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_section_that_nobody_knows_is_named() -> None:
    assert read(GOOD.replace("EOF::", "PLOT STYLE::\nblue\nEOF::")).notes == ("section PLOT STYLE (line 40) is not known and was not read",)
