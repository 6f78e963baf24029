"""Array aliases used by all models: F1 (n,), F2 (n, k), F3 (n, k, m), F4 (n, k, m, l), all float64."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F1 = NDArray[np.float64]
F2 = NDArray[np.float64]
F3 = NDArray[np.float64]
F4 = NDArray[np.float64]
