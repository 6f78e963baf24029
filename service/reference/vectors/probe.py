"""`probe.json`: frame and angles of a tilting probe, calibration on a master sphere, geometry and probe combined."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from abbe.models.arrays import F1
from abbe.models.papers.probe.calibration import calibrate
from abbe.models.papers.probe.model import combined_deviation_mm, direction, direction_angles, printed_eq17_mm, probe_frame, to_probe
from abbe.service.reference.vector_checks import Checks
from abbe.service.reference.vector_file import VectorCase

Lobe = Callable[[F1, F1], F1]
NUMBER = r"([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)"
LOBE = re.compile(rf"lobe\(ph,th\)={NUMBER} sin\(ph\)\^2 cos\(3th\+{NUMBER}\)\+{NUMBER}\(cos\(ph\)\^2-1/3\)\+{NUMBER} sin\(2ph\)cos\(th\)")
"""Formula of the lobing in the text of the file, with its four numbers as groups."""
COORDINATES = "coordinates of up to 150 mm were subtracted"


def read(case: VectorCase, checks: Checks) -> None:
    """Compare everything in the file."""
    for part in case.at("directions").parts():
        _direction(part, checks)
    lobe = stated_lobe(case.text("note"))
    _sphere(case.at("sphere"), lobe, checks)
    for part in case.at("combined").parts():
        _combined(part, lobe, checks)


def stated_lobe(note: str) -> Lobe | None:
    """Return the lobing function from the text of the file, mm over colatitude and longitude; None if the formula is unknown."""
    found = LOBE.search(note)
    if found is None:
        return None
    triple, phase, zonal, tesseral = (float(v) for v in found.groups())

    def lobe(ph: F1, th: F1) -> F1:
        value = triple * np.sin(ph) ** 2 * np.cos(3.0 * th + phase) + zonal * (np.cos(ph) ** 2 - 1.0 / 3.0)
        return np.asarray(value + tesseral * np.sin(2.0 * ph) * np.cos(th))

    return lobe


def _direction(part: VectorCase, checks: Checks) -> None:
    frame = probe_frame(part.array("A"), part.array("B"))
    checks.compare("Tp", frame, part.at("Tp"), unit="1", floor=4e-16)
    in_probe = to_probe(frame, part.array("n_machine", shape=(3,)))
    checks.compare("direction in the probe frame", in_probe, part.at("n_probe"), unit="1", floor=4e-16)
    colatitude, longitude = direction_angles(in_probe)
    checks.compare("colatitude", colatitude, part.at("colatitude"), unit="rad", floor=1e-15)
    checks.compare("longitude", longitude, part.at("longitude"), unit="rad", floor=2e-15)


def _sphere(part: VectorCase, lobe: Lobe | None, checks: Checks) -> None:
    centres, angles = part.array("ball_centres", shape=(None, 3)), part.array("colat_lon", shape=(None, 2))
    middle, normal = part.array("centre", shape=(3,)), direction(angles[:, 0], angles[:, 1])
    away = np.linalg.norm(centres - middle, axis=1)
    stored = part.at("ball_centres")
    if lobe is None:
        along = middle + away[:, None] * normal
        checks.check_form("ball centres along their directions", along, stored, unit="mm", floor=5e-14, rounding=COORDINATES)
    else:
        # The distance of a touch is sphere radius plus ball radius minus the probe error.
        error = lobe(angles[:, 0], angles[:, 1])
        radius = float(np.median(away + error))
        tip = radius - part.number("Rs")
        checks.assume(f"the ball of the stylus has a radius of {tip:.6g} mm, which agrees with all ball centres")
        at = middle + (radius - error)[:, None] * normal
        checks.compare("ball centres", at, stored, unit="mm", floor=2e-13, rounding=COORDINATES)
    found = calibrate(centres, angles, part.number("Rs"))
    for name, value, key in (
        ("centre of the fitted sphere", found.fit.centre_mm, "fit_centre"),
        ("radius of the fitted sphere", found.fit.radius_mm, "fit_radius"),
        ("effective radius", found.effective_radius_mm, "Reff"),
        ("lobing", found.probe_mm, "probe_est"),
    ):
        checks.compare(name, value, part.at(key), unit="mm", floor=5e-14, rounding=COORDINATES)


def _combined(part: VectorCase, lobe: Lobe | None, checks: Checks) -> None:
    n, off = part.array("n_outward", shape=(3,)), part.array("Delta", shape=(3,))
    frame = probe_frame(part.array("A"), part.array("B"))
    if lobe is None:
        # Touches may lie below the equator, outside the calibration of the file.
        checks.leave_out("probe error of a touch", part.at("probe"), "the text of the file states no known lobing function")
        probe = part.array("probe")
    else:
        probe = lobe(*direction_angles(to_probe(frame, n)))
        checks.compare("probe error of a touch", probe, part.at("probe"), unit="mm", floor=5e-17, rounding="sum of three products")
    found = combined_deviation_mm(off, probe, n)
    checks.compare("actual - reading", found, part.at("actual_minus_reading"), unit="mm", floor=5e-17)
    approach, outward = printed_eq17_mm(off, probe, n, "approach"), printed_eq17_mm(off, probe, n, "outward")
    checks.compare("eq (17), M is the approach", approach, part.at("printed_eq17_with_M=approach=-n"), unit="mm", floor=5e-17)
    checks.compare("eq (17), M points outward", outward, part.at("printed_eq17_with_M=outward"), unit="mm", floor=5e-17)
