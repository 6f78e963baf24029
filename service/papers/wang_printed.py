"""Wang: the numbers of Part I as printed. It holds no measured data."""

from __future__ import annotations

from abbe.service.papers.printed import Printed, printed

PROJECTION, RESOLUTION = printed("0.577", "1.732")
"""IV.A: projection of an axis' error on the diagonal of a cube, and the factor on the resolution."""

BEAM_MM_PER_M = Printed("1")
COSINE_UM_PER_M = Printed("0.51", bound=True)
"""IV.B: upper bound for a beam misaligned by 1 mm in 1 m."""

MIRROR_MRAD, STEP_MM = printed("0.5", "50")
MIRROR_UM = Printed("25", bound=True)
"""IV.C: upper bound for a mirror tilted by this angle and a step of this length."""
