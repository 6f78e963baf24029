"""`abbe device interferometer`: three kinds of tables, text and JSON, and tables that cannot show a cyclic error."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.service.cli.test_cli import Abbe, abbe

__all__ = ["abbe"]  # the fixture
pytestmark = pytest.mark.usefixtures("clean_environment")


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def write(heading: str, *columns: np.ndarray) -> None:
    Path("t.csv").write_text("\n".join([heading, *(", ".join(map(str, row)) for row in np.column_stack(columns))]) + "\n")


PHASE = np.linspace(0.0, 50.0, 2000)
X, Y = 5.0 + 500.0 * np.cos(PHASE), 500.0 * np.sin(PHASE)


def test_signals_in_quadrature(abbe: Abbe) -> None:
    write("sin, cos", X, Y)
    done = abbe("device", "interferometer", "t.csv")
    assert done.code == 0, done.err
    assert "cyclic error of the interferometer (periodic nonlinearity), not of a drive" in done.out
    assert "order 1, once per fringe: amplitude 0.50" in done.out
    assert "signals: offsets 1.00 and " in done.out
    assert done.err.endswith("next: abbe effects cyclic_error\n")


def test_phase_and_radius_are_the_same_signals(abbe: Abbe) -> None:
    write("a, b", X, Y)
    plain = json.loads(abbe("device", "interferometer", "t.csv", "--json").out)
    write("Phase (deg), Radius, Roundness deviation", np.degrees(np.arctan2(Y, X)), np.hypot(X, Y), 0.0 * X)
    polar = json.loads(abbe("device", "interferometer", "t.csv", "--json").out)
    assert polar["orders"][0]["amplitude_nm"] == pytest.approx(plain["orders"][0]["amplitude_nm"], rel=1e-6)
    assert polar["orders"][0]["amplitude_nm"] == pytest.approx(316.4 / (2.0 * np.pi) * 0.01, rel=1e-3)


def test_a_slow_linear_run(abbe: Abbe) -> None:
    position_um = np.linspace(0.0, 3.0, 1000)
    deviation_nm = 2.0 * np.sin(2.0 * np.pi * position_um / 0.158) + np.random.default_rng(1).normal(0.0, 0.3, 1000)
    write("position (um), deviation (nm)", position_um, deviation_nm)
    found = json.loads(abbe("device", "interferometer", "t.csv", "--fringe", "158", "--json").out)
    first, second = found["orders"]
    assert first["amplitude_nm"] == pytest.approx(2.0, abs=0.1)
    assert first["p"] < 1e-6
    assert second["amplitude_nm"] < 0.2
    assert "not proved" in abbe("device", "interferometer", "t.csv", "--fringe", "158").out or second["p"] < 0.01


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sin, cos\n1, 2\n3\n", "t.csv:3: expected two columns with headings"),
        ("sin, cos\n1, 2\n3, x\n", "t.csv:3: cos is 'x'"),
        ("sin, cos\n1, 2\n3, 4\n", "t.csv: 2 samples, expected 96 or more"),
    ],
)
def test_a_table_that_shows_nothing_is_refused(abbe: Abbe, text: str, words: str) -> None:
    Path("t.csv").write_text(text)
    assert words in abbe.fails("device", "interferometer", "t.csv")
