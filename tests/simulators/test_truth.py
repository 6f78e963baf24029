"""Figures of the sealed truth and the ``truth`` command."""

import json
import struct
import subprocess
import sys

import numpy as np
import pytest

from abbe.simulators import sealed as figures
from abbe.simulators.scenario import from_dict
from abbe.simulators.truth.draws import draw_machine
from abbe.simulators.truth.machine import Geometry, Machine


def machine(scenario) -> Machine:
    return Machine(Geometry(scenario.machine), draw_machine(scenario))


def test_perfect_tables_leave_nothing_on_a_machine_without_angles(scenario) -> None:
    m = machine(scenario(scale_sd_um_per_m=40.0, squareness_sd_urad=25.0, positioning_rms_um=[3, 3], straightness_rms_um=[2, 2]))
    assert figures.best_nine_tables_rms_um(m) < 1e-6
    assert figures.rms_norm(figures.without_rigid_motion(figures.grid(m, 5), figures.deviation(m, figures.grid(m, 5)))) > 1e-3


@pytest.mark.parametrize("seed", range(10))
def test_best_nine_tables_are_no_worse_than_nothing(seed: int) -> None:
    m = machine(from_dict({"seed": seed}))
    points = figures.grid(m, 9)
    uncorrected = 1000.0 * figures.rms_norm(figures.without_rigid_motion(points, figures.deviation(m, points)))
    assert 0.0 < figures.best_nine_tables_rms_um(m, 9) <= uncorrected


def test_rigid_motion_is_removed_and_nothing_else() -> None:
    rng = np.random.default_rng(6)
    points = rng.uniform(0, 500, (300, 3))
    omega, shift = np.array([1e-5, -2e-5, 3e-5]), np.array([0.01, 0.02, -0.03])
    rigid = shift + np.cross(omega, points)
    assert np.abs(figures.without_rigid_motion(points, rigid)).max() < 1e-12
    noise = rng.normal(size=(300, 3))
    np.testing.assert_allclose(figures.without_rigid_motion(points, noise + rigid), figures.without_rigid_motion(points, noise), atol=1e-12)
    stretch = points * [1e-5, 0, 0]
    assert figures.rms_norm(figures.without_rigid_motion(points, stretch)) > 1e-4


def test_body_diagonals_of_a_pure_scale(scenario) -> None:
    m = machine(scenario())
    m.extra_scale[:] = [100e-6, 0.0, 0.0]
    ranges = figures.body_diagonals_um(m)
    expected = 100e-6 * 600.0 * 600.0 / np.sqrt(600.0**2 + 500.0**2 + 450.0**2) * 1000.0
    assert ranges == pytest.approx(dict.fromkeys(("ppp", "npp", "pnp", "ppn"), expected))


def test_body_diagonals_tell_the_sign_of_squareness(scenario) -> None:
    m = machine(scenario())
    object.__setattr__(m.draws, "squareness", np.array([1e-4, 0.0, 0.0]))  # the axes X and Y include more than a right angle
    ranges = figures.body_diagonals_um(m)
    length = np.sqrt(600.0**2 + 500.0**2 + 450.0**2)
    assert ranges == pytest.approx(dict.fromkeys(("ppp", "npp", "pnp", "ppn"), 1e-4 * 500.0 * 600.0 / length * 1000.0))
    low, high = m.geometry.low_mm, m.geometry.high_mm
    along = figures.deviation(m, np.array([low, high])) @ ((high - low) / length)
    assert along[1] < along[0], "ppp is too short when C0Y > 0"


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "abbe.simulators", "truth", *arguments], capture_output=True, text=True, check=False)


def test_command_with_and_without_a_bank(tmp_path) -> None:
    plain = json.loads(run("--seed", "3", "--nodes", "5", "--arrows").stdout)
    drawn = draw_machine(from_dict({"seed": 3}))
    assert plain["seed"] == 3
    assert plain["scale_um_per_m"]["X"] == pytest.approx(drawn.scale[0] * 1e6, abs=1e-4)
    assert plain["noise_bar_um"] == pytest.approx(drawn.bar_noise_mm * 1e3, abs=1e-4)
    assert plain["max_body_diagonal_um"] == max(plain["body_diagonals_um"].values())
    assert plain["volumetric_max_um"] >= plain["volumetric_rms_um"] >= plain["best_nine_tables_rms_um"]
    arrows = np.array(plain["deviation_um"])
    assert np.array(plain["grid_mm"]).shape == arrows.shape == (125, 3)
    assert figures.rms_norm(arrows) == pytest.approx(plain["volumetric_rms_um"])
    # taking the linear scales out again is better than nothing
    lsb = [round(-drawn.scale[a] * stroke * 1e4) for a, stroke in enumerate((600, 500, 450))]
    body = [v for a in range(3) for i in range(3) for v in (0, lsb[a] if i == a else 0)]
    data = struct.pack(">4HIHH3HH3i3i", 0xABBE, 1, 1, 24 + 18, 1, 100, 0, 2, 2, 2, 0, 0, 0, 0, 60_000_000, 50_000_000, 45_000_000)
    (tmp_path / "bank.bin").write_bytes(data + struct.pack(">18h", *body))
    corrected = json.loads(run("--seed", "3", "--nodes", "5", "--bank", str(tmp_path / "bank.bin")).stdout)
    assert "grid_mm" not in corrected
    assert corrected["volumetric_rms_um"] < plain["volumetric_rms_um"]
    assert corrected["best_nine_tables_rms_um"] == plain["best_nine_tables_rms_um"]


@pytest.mark.parametrize("content", [b"", b"odd", b"\xab\xbe" * 30])
def test_command_refuses_what_is_no_image(tmp_path, content: bytes) -> None:
    (tmp_path / "bad.bin").write_bytes(content)
    done = run("--bank", str(tmp_path / "bad.bin"))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error USE-001: simulators: bank image: ")
    assert done.stderr.count("\n") == 1


def test_command_names_a_missing_scenario(tmp_path) -> None:
    done = run(str(tmp_path / "none.toml"))
    assert done.returncode == 2
    assert "none.toml" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_plane_sees_neither_height_nor_rigid_motion(scenario) -> None:
    m = machine(scenario(scale_sd_um_per_m=40.0))
    box = [100.0, 400.0, 100.0, 400.0, 200.0]
    before = figures.plane_rms_um(m, figures.no_correction, box)
    assert before > 1.0
    lifted = figures.plane_rms_um(m, lambda command: np.full_like(command, 0.02), box)
    assert lifted == pytest.approx(before, abs=0.01)
