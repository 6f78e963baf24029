"""What poses of a plate hide, and what one workpiece alone shows."""

from __future__ import annotations

import numpy as np
import pytest

from abbe.models.solvers.artefact import ArtefactPoints
from abbe.models.solvers.observability.poses import pose_rank
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.plate_fit import plate_fit

N = np.array([[i % 5 * 50.0, i // 5 * 50.0, 0.0] for i in range(25)])
CENTRE = N.mean(axis=0)
NAMES = tuple(f"H{i}" for i in range(25))


def pose(degrees: float, shift: tuple[float, float] = (0.0, 0.0), source: str = "probe") -> RunData:
    """A plate of 5 x 5 holes turned about its centre, and shifted."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.round(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), 12)
    rows = np.tile(np.arange(25), 2)
    points = ArtefactPoints(
        "A", source, turn, tuple(NAMES[i] for i in rows), np.repeat([0, 1], 25), N[rows], np.zeros((50, 3)), np.zeros(50), 1e-5, 1e-6,
        np.full(50, np.nan), 150.0, CENTRE, calibrated=False, u_cmm_scale=1e-6,
    )  # type: ignore[arg-type] # fmt: skip
    at = (N - CENTRE) @ turn.T + CENTRE + [300.0 + shift[0], 150.0 + shift[1], 200.0]
    label = f"{degrees:g} {shift}"
    return RunData(label, label, "artefact", at[rows], np.zeros(50), np.zeros((50, 3)), np.arange(50.0), np.ones(50), points=points)


@pytest.mark.parametrize(
    ("poses", "rank", "hidden"),
    [
        ([(0, (0, 0))], 0, 5),
        ([(0, (0, 0)), (180, (0, 0))], 16, 5),
        ([(0, (0, 0)), (90, (0, 0))], 22, 3),
        ([(a, (0, 0)) for a in (0, 90, 180, 270)], 22, 3),
        ([(0, (0, 0)), (0, (68, 0)), (0, (0, 68))], 24, 3),
        ([(0, (0, 0)), (90, (0, 0)), (0, (68, 0))], 26, 1),
        ([(0, (0, 0)), (90, (30, 0)), (180, (0, 40)), (270, (25, -30))], 26, 1),
    ],
)
def test_poses_show_so_many_of_the_27_fields_of_degree_4(poses: list, rank: int, hidden: int) -> None:
    """The table of exact ranks; 180 degrees and shifts alone hide what a quarter turn shows, and all of them the scale."""
    found = pose_rank(tuple(pose(*one) for one in poses))
    assert found is not None
    assert (found.rank, len(found.hidden)) == (rank, hidden)
    assert found.hidden[0] == "scale"


def test_the_pose_that_would_tell_most_is_named() -> None:
    """After 0 and 180 degrees a quarter turn tells all but the scale."""
    found = pose_rank((pose(0), pose(180)))
    assert found is not None
    name, rank, told = found.cures[0]
    assert (name, rank) == ("turned by 90 degrees", 22) or rank >= 22
    assert "squareness" in told
    assert "A further pose would show more" in found.text


def made(field: np.ndarray) -> RunData:
    """A workpiece that a CMM measured with these deviations of its holes, (25, 2) mm."""
    run = pose(0, source="cmm")
    return RunData(
        "w1", "w1", "artefact", run.axes_mm, field.T.ravel(), run.sign, run.t_s, run.weight_n, points=run.points
    )  # fmt: skip


def test_a_plate_alone_gives_scales_and_squareness_as_planted() -> None:
    """Offset, rotation, 40 and -20 ppm, 30 urad obtuse; nothing else, so the answer is the planted one and says no swirl."""
    x, y = N[:, 0], N[:, 1]
    field = np.stack([0.1 + 40e-6 * x - 30e-6 * y - 1e-4 * y, -0.2 - 20e-6 * y + 1e-4 * x], axis=1)
    found = plate_fit(made(field))
    assert found is not None
    assert found.value[:3] == pytest.approx([40e-6, -20e-6, 30e-6], abs=1e-9)
    assert found.value[3] == pytest.approx(0.0, abs=1e-9)
    assert found.rms_mm < 1e-9
    assert "EXX +40" in found.text
    assert "unknown" not in found.verdict


def test_a_swirl_is_called_unknown_because_one_plate_cannot_exclude_the_machine() -> None:
    """A rotation growing with r^2, 25 um at the farthest hole."""
    q = (N - CENTRE)[:, :2] / np.linalg.norm((N - CENTRE)[0])
    found = plate_fit(made(0.025 * np.stack([-q[:, 1], q[:, 0]], axis=1) * (q**2).sum(axis=1, keepdims=True)))
    assert found is not None
    assert found.value[3] == pytest.approx(0.025, rel=1e-6)
    assert found.verdict.startswith("unknown: one plate cannot show whether the rotation growing with r²")
    assert plate_fit(pose(0)) is None  # a probed plate says nothing alone
