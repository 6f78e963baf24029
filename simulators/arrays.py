"""Array aliases of the simulated world."""

import numpy as np
from numpy.typing import NDArray

F = NDArray[np.float64]
"""Array of float64; shape and unit are stated where it is used."""

I64 = NDArray[np.int64]
"""Array of int64."""

B = NDArray[np.bool_]
"""Array of booleans."""
