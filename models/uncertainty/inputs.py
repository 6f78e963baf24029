"""Stated inputs of an uncertainty budget, in addition to the campaign's data; each default is an ASSUMPTION.

The solution of a campaign includes the noise of its readings and the priors of its set-ups, but not temperatures or errors that its smooth
model cannot follow. These inputs are stated here, and the budget marks them as stated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from abbe.models.solvers.priors import U_WAVELENGTH

STEEL_PER_K = 11.5e-6
"""Linear expansion of steel scales and bars, 1/K; glass has about 8e-6, carbon fibre and Invar about 1e-6."""


@dataclass(frozen=True, slots=True)
class StatedInputs:
    """Stated standard uncertainties that no reading of the campaign can show.

    Attributes
    ----------
    u_wavelength : float
        Relative standard uncertainty of the laser's wavelength after air compensation; all runs share one laser. This input is used only if
        the wavelength is not an unknown of the solution.
    u_scale_temperature_k, scale_expansion_per_k : float
        Standard uncertainty of each scale's temperature, K, and expansion coefficient of the scales, 1/K. 0.2 K stands for a Pt100 on the
        scale and a drift of ±0.3 K during the campaign. The three axes are independent.
    u_bar_temperature_k, bar_expansion_per_k : float
        Standard uncertainty of the bar's temperature relative to its calibration temperature, K, and expansion coefficient of the bar, 1/K;
        one thermometer serves all bar runs.
    repeatability_mm : float
        Standard deviation of the machine from one approach of a point to the next, per component. The readings' scatter contains this
        repeatability, so the budget subtracts it from the noise of the readings, down to zero. Default 0: not known separately.
    repeatability_dof : float
        Degrees of freedom of ``repeatability_mm``; inf if it is stated.
    single_approach : bool
        False (default): the predicted deviation is the mean of many approaches. True: it is the deviation of one
        approach, with its repeatability on top.
    orders_above : int
        Number of Legendre orders above those of the solution that the machine's errors may contain; 0: none.

    Raises
    ------
    ValueError
        A figure is negative or not finite.
    """

    u_wavelength: float = U_WAVELENGTH
    u_scale_temperature_k: float = 0.2
    scale_expansion_per_k: float = STEEL_PER_K
    u_bar_temperature_k: float = 0.2
    bar_expansion_per_k: float = STEEL_PER_K
    repeatability_mm: float = 0.0
    repeatability_dof: float = float("inf")
    single_approach: bool = False
    orders_above: int = 4

    def __post_init__(self) -> None:
        """Refuse negative figures, which would go unnoticed once squared."""
        for name in (
            "u_wavelength", "u_scale_temperature_k", "scale_expansion_per_k",
            "u_bar_temperature_k", "bar_expansion_per_k", "repeatability_mm",
        ):  # fmt: skip
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"uncertainty inputs: {name} is {value}, must be a number of 0 or more")
        if self.orders_above < 0 or not self.repeatability_dof > 0:
            raise ValueError(
                f"uncertainty inputs: orders_above is {self.orders_above}, must be 0 or more; "
                f"repeatability_dof is {self.repeatability_dof}, must be above 0"
            )

    def as_measured(self) -> StatedInputs:
        """The same inputs for a prediction at the temperature of the measurement, where the scales' temperature has no uncertainty."""
        return replace(self, u_scale_temperature_k=0.0)

    def without_stated_inputs(self) -> StatedInputs:
        """The same inputs with every uncertainty zero: only the covariance of the solution remains."""
        return replace(
            self,
            u_wavelength=0.0,
            u_scale_temperature_k=0.0,
            u_bar_temperature_k=0.0,
            repeatability_mm=0.0,
            single_approach=False,
            orders_above=0,
        )
