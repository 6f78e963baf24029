"""The step file of every format does to a machine what its two sentences say, read back as the control would."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from abbe.models.machine import Machine
from abbe.service.cli import run
from abbe.service.compensation.comp_export import control_for, settings_for
from abbe.service.formats.model import correction_at
from abbe.service.formats.registry import FORMATS
from abbe.service.formats.step import step_of

MACHINE = Machine("w-X-b-Y-Z-t", np.array([[0.0, 500.0], [-200.0, 200.0], [-300.0, 0.0]]))


@pytest.mark.parametrize("reference", [MACHINE.stroke_mm[:, 0], MACHINE.stroke_mm[:, 1], np.zeros(3)], ids=["start", "end", "zero"])
@pytest.mark.parametrize("key", FORMATS)
def test_one_axis_moves_by_ten_micrometres_and_nothing_at_the_reference(key: str, reference: np.ndarray) -> None:
    form = FORMATS[key]
    told = settings_for(control_for(key), MACHINE, reference)
    if key == "centroid" and not any(abs(reference[0] - e) < 1e-9 for e in MACHINE.stroke_mm[0]):
        pytest.skip("its reference is at an end of the table")
    step = step_of(form, MACHINE, 0, reference)
    comp = form.read(form.write(step.compensation, told), told)
    places = np.meshgrid(*[np.linspace(low, high, 9) for low, high in MACHINE.stroke_mm])
    at = np.array(places).reshape(3, -1).T
    moved = correction_at(comp, at, np.full(at.shape, -1.0)) - correction_at(comp, reference[None], -np.ones((1, 3)))
    size = np.ptp(moved, axis=0)
    lines, lost = form.limits.lines and form.limits.cross, form.limits.lines and not form.limits.cross
    if lost:
        assert correction_at(comp, at, np.full(at.shape, -1.0))[:, 0] == pytest.approx(-0.010)
        return
    assert size[0] == pytest.approx(0.010, abs=1e-6)
    assert size[1:].max() < 1e-6
    if not lines:
        assert moved[:, 0].min() == pytest.approx(-0.010, abs=1e-6)
        assert "X has to move by -10 µm" in step.expected


def test_the_command_says_where_to_measure_what(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("abbe.toml").write_text('name = "m"\nchain = "w-X-b-Y-Z-t"\n[stroke_mm]\nX = [0, 500]\nY = [-200, 200]\nZ = [-300, 0]\n')
    assert run(["comp", "step", "--format", "siemens-cec", "--axis", "Y", "--out", "step.ini"]) == 0
    said = capsys.readouterr().out
    assert "go to Y 0 moving in +, with and without the file: Y has to move by -10 µm" in said
    assert "$AN_CEC[0,2]=-0.01\n" in Path("step.ini").read_text()
    assert run(["comp", "step", "--format", "siemens-cec", "--axis", "A", "--out", "x"]) == 2
