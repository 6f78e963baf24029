"""Stated inputs of an uncertainty budget beside the campaign's data, with documented defaults, each an ASSUMPTION.

The solution of a campaign includes the noise of its readings and the priors of its set-ups. It does not include the laser's wavelength,
temperatures, and errors that a smooth model cannot follow: those are stated here, and the budget prints them as stated.
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
        Of the laser's wavelength after air compensation, relative; one laser in all runs. Default:
        `abbe.models.solvers.priors.U_WAVELENGTH`.
    u_scale_temperature_k, scale_expansion_per_k : float
        How well the temperature of each axis' scale is known, K, for which the prediction holds; 0.2 K is a Pt100 on the scale and a drift
        of ±0.3 K in the campaign. The three axes are independent. Expansion coefficient of the scales.
    u_bar_temperature_k, bar_expansion_per_k : float
        The same of the ball-bar against the temperature of its calibration; one thermometer for all bar runs.
    repeatability_mm : float
        Standard deviation of the machine from one approach of a point to the next, per component. It is part of the scatter of the
        readings: the budget takes its share out of theirs, at most all of it. Default 0: not known apart.
    repeatability_dof : float
        Degrees of freedom of that figure; inf when it is stated.
    single_approach : bool
        False (default): the predicted deviation is the mean of many approaches. True: that of one approach, with its repeatability on top.
    orders_above : int
        How many Legendre orders above the chosen one may still be in the machine (model order); 0 leaves them out.

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
        """A negative uncertainty would be squared and never seen."""
        for name in (
            "u_wavelength", "u_scale_temperature_k", "scale_expansion_per_k",
            "u_bar_temperature_k", "bar_expansion_per_k", "repeatability_mm",
        ):  # fmt: skip
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"uncertainty inputs: {name} is {value}, must be a number of 0 or more")
        if self.orders_above < 0 or not self.repeatability_dof > 0:
            raise ValueError("uncertainty inputs: orders_above must be 0 or more, repeatability_dof above 0")

    def as_measured(self) -> StatedInputs:
        """The inputs at the temperature of the measurement: without the temperature of the scales."""
        return replace(self, u_scale_temperature_k=0.0)

    def without_stated_inputs(self) -> StatedInputs:
        """Zero stated inputs: only the covariance of the solution itself remains."""
        return replace(
            self,
            u_wavelength=0.0,
            u_scale_temperature_k=0.0,
            u_bar_temperature_k=0.0,
            repeatability_mm=0.0,
            single_approach=False,
            orders_above=0,
        )
