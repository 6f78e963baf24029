"""Wang, section IV: the numbers of the error discussion. Part I of the paper has no measured data."""

from __future__ import annotations

import math

import numpy as np

from abbe.models.papers.wang.model import cosine_error, diagonal_beam, mirror_normal, projection_factors, reading_mm, tilt_axes
from abbe.service.reference.comparison import Comparison, Erratum
from abbe.service.reference.printed import Computed, Printed, printed

PROJECTION, RESOLUTION = printed("0.577", "1.732")
"""IV.A: projection of an axis' error on the diagonal of a cube, and the factor on the resolution."""

BEAM_MM_PER_M = Printed("1")
COSINE_UM_PER_M = Printed("0.51", bound=True)
"""IV.B: upper bound for a beam misaligned by 1 mm in 1 m."""

MIRROR_MRAD, STEP_MM = printed("0.5", "50")
MIRROR_UM = Printed("25", bound=True)
"""IV.C: upper bound for a mirror tilted by this angle and a step of this length."""

CUBE = np.ones(3)


def comparisons() -> list[Comparison]:
    """Return the comparisons of every number of the paper, in printed order."""
    share = float(projection_factors(CUBE)[0])
    # Literally, the text's "one over root three squared" is a third.
    literal = Erratum("the text writes 1/√3²; 1/√3 is meant", Computed(share))
    of_cube = "projection_factors of a cube"
    return [
        Comparison("IV.A", "share of an axis' error seen on the diagonal", "", PROJECTION, Computed(share), of_cube),
        Comparison(
            "IV.A", "the same as the text writes it, 1/√3²", "", PROJECTION, Computed(share**2), of_cube, erratum=literal, again=True
        ),
        Comparison("IV.A", "factor on the resolution", "", RESOLUTION, Computed(1.0 / share), f"1 / {of_cube}"),
        _cosine(),
        _mirror(),
    ]


def _cosine() -> Comparison:
    misaligned = math.atan(BEAM_MM_PER_M.value * 1e-3)
    computed = Computed(cosine_error(misaligned) * 1e6)
    how = "cosine_error of 1 mm in 1 m"
    why = "second order of the angle; the paper gives an upper bound"
    return Comparison("IV.B", "cosine error, beam askew by 1 mm in 1 m", "µm/m", COSINE_UM_PER_M, computed, how, why)


def _mirror() -> Comparison:
    beam = diagonal_beam(CUBE, "ppp")
    tilt = np.array([MIRROR_MRAD.value * 1e-3, 0.0])
    step = STEP_MM.value * tilt_axes(beam)[:1]
    computed = Computed(1e3 * abs(float(reading_mm(step, mirror_normal(beam, tilt), beam)[0])))
    how = "reading_mm of a 50 mm step across the beam to a mirror_normal tilted by 0.5 mrad"
    why = (
        "the paper gives an upper bound. It calls the error constant and removable by calculation; but that also removes 12 slopes and"
        " leaves only 3 squareness errors and one weighted scale error"
    )
    return Comparison("IV.C", "mirror askew by 0.5 mrad, step of 50 mm", "µm", MIRROR_UM, computed, how, why)
