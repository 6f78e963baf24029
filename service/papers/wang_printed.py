"""Wang: the numbers of Part I as printed. It holds no measured data."""

from __future__ import annotations

from abbe.service.papers.printed import Printed, printed

PROJECTION, RESOLUTION = printed("0.577", "1.732")
"""IV.A: share of an axis' error seen along the diagonal of a cube, and the factor on the resolution."""

BEAM_MM_PER_M = Printed("1")
COSINE_UM_PER_M = Printed("0.51", bound=True)
"""IV.B: beam misaligned by 1 mm in 1 m gives less than this."""

MIRROR_MRAD, STEP_MM = printed("0.5", "50")
MIRROR_UM = Printed("25", bound=True)
"""IV.C: mirror askew by this angle, step of this length, gives less than this."""
