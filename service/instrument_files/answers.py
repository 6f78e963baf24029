"""Facts that a file does not state: questions, answers, and unknown facts that widen U."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from abbe.service.config_schema import COLDEST_C, WARMEST_C
from abbe.service.errors import FileFormatError
from abbe.service.instrument_files.content import HPA, AxisReadings, Content

U_SCALE_TEMPERATURE_K = 10.0 / np.sqrt(12.0)
"""Standard uncertainty of an unknown temperature of the scales, K: anything from 15 to 25 °C (an assumption)."""
U_WAVELENGTH = float(np.hypot(0.95e-6 * 10.0 / np.sqrt(12.0), 0.268e-8 * 6000.0 / np.sqrt(12.0)))
"""Relative standard uncertainty of the wavelength if the file does not say how the air was compensated: 15 to 25 °C and 980 to 1040 hPa,
with 0.95 ppm/K and 0.268 ppm/hPa (Edlen's formula at 20 °C and 1013.25 hPa; the ranges are an assumption)."""
LENGTHS = {"mm": 1.0, "um": 1e-3, "nm": 1e-6, "m": 1e3, "in": 25.4}
"""Units of length by name, mm."""
ANGLES = {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": np.pi / 180.0, "arcsec": np.pi / 648000.0}
"""Units of angle by name, rad."""
SIGNS = {"measured-nominal": 1.0, "nominal-measured": -1.0}

BOUNDS = {
    "at_mm": (-1e5, 1e5, "mm"),
    "scale_c": (COLDEST_C, WARMEST_C, "degrees C"),
    "air_c": (COLDEST_C, WARMEST_C, "degrees C"),
    "pressure_hpa": (600.0, 1100.0, "hPa"),
    "feed_mm_min": (1e-3, 1e6, "mm/min"),
}
"""Possible numbers of an answer, and their unit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answers:
    """Answers of a person; None: not answered.

    ``axis``: X, Y or Z; ``unit``: unit of the readings, a key of `LENGTHS`; ``sign``: a key of `SIGNS`; ``at_mm``: where the axis stood
    during a trace; temperatures in °C, ``pressure_hpa`` of the air.
    """

    axis: str | None = None
    unit: str | None = None
    sign: str | None = None
    at_mm: float | None = None
    scale_c: float | None = None
    air_c: float | None = None
    pressure_hpa: float | None = None
    feed_mm_min: float | None = None


@dataclass(frozen=True, slots=True)
class Question:
    """Question to answer before a file can be used: the field of `Answers`, its text, and the possible answers (empty: a number)."""

    key: str
    text: str
    choices: tuple[str, ...] = ()


def checked(answers: Answers) -> Answers:
    """Return the answers if each is possible.

    Raises
    ------
    FileFormatError
        An answer is impossible.
    """
    for key, choices in (("axis", ("X", "Y", "Z")), ("unit", tuple(LENGTHS)), ("sign", tuple(SIGNS))):
        value = getattr(answers, key)
        if value is not None and value not in choices:
            raise FileFormatError(f"--{key} is {value!r}", f"give one of {', '.join(choices)}")
    for key, (low, high, what) in BOUNDS.items():
        value = getattr(answers, key)
        if value is not None and not low <= value <= high:
            raise FileFormatError(f"--{option(key)} is {value:g}", f"give {what} from {low:g} to {high:g}")
    return answers


def open_questions(content: Content, answers: Answers) -> list[Question]:
    """Return the questions that neither the file nor an answer settles; the file is refused until each is answered."""
    out = []
    one: Any = content.test or content.trace
    if one is not None and not one.axis and answers.axis is None:
        out.append(Question("axis", "which axis was measured", ("X", "Y", "Z")))
    if (content.trace is not None or not content.unit_known) and answers.unit is None:
        out.append(Question("unit", "the unit of the readings", tuple(LENGTHS)))
    if content.test is not None and not content.test.sign_known and answers.sign is None:
        out.append(Question("sign", "what the values are: the deviation (+: the axis went too far), or the correction of it", tuple(SIGNS)))
    if content.trace is not None and answers.at_mm is None:
        out.append(Question("at_mm", "where the axis stood, mm (a trace of a moving axis does not say where each sample was taken)"))
    return out


def settled(content: Content, answers: Answers) -> AxisReadings | None:
    """The test of a file with every answer applied; None if the file has no test.

    Raises
    ------
    FileFormatError
        A question is open, or an answer contradicts the file.
    """
    left = open_questions(content, answers)
    if left:
        one = left[0]
        among = f" ({', '.join(one.choices)})" if one.choices else ""
        raise FileFormatError(f"{content.name}: the file does not say {one.text}", f"give --{option(one.key)} VALUE{among}")
    found: Any = content.test or content.trace
    if found is not None and found.axis and answers.axis not in (None, found.axis):
        raise FileFormatError(f"{content.name}: --axis is {answers.axis}, the file says {found.axis}", "leave out --axis")
    test = content.test
    if test is None:
        return None
    sign = SIGNS[answers.sign] if answers.sign and not test.sign_known else 1.0
    unit = 1.0 if content.unit_known else LENGTHS[str(answers.unit)]
    return replace(
        test,
        axis=test.axis or str(answers.axis),
        deviation=test.deviation * (sign * unit),
        resolution=test.resolution * unit,
        feed_mm_min=test.feed_mm_min or answers.feed_mm_min,
        further=_further(test, test.axis or str(answers.axis), answers),
    )


def option(key: str) -> str:
    """Name of the option of an answer."""
    return {"at_mm": "at", "scale_c": "scale-temperature", "air_c": "air-temperature", "pressure_hpa": "air-pressure"}.get(key, key)


def _further(test: AxisReadings, axis: str, answers: Answers) -> dict[str, Any]:
    """Return the further columns: those of the file, and the answers for columns that the file lacks."""
    given = {f"temp_{axis.lower()}_C": answers.scale_c, "temp_air_C": answers.air_c}
    given["pressure_air_Pa"] = None if answers.pressure_hpa is None else answers.pressure_hpa * HPA
    n = test.position_mm.size
    return {name: np.full(n, value) for name, value in given.items() if value is not None} | dict(test.further)


MATERIAL_UNKNOWN = (
    "whether the instrument reduced the deviations to 20 °C: Abbe assumes that it did not; if it did, state its coefficient as "
    "`laser_per_k` in the machine file"
)


def unknown_of(test: AxisReadings) -> list[str]:
    """Unknown facts of a test, as text for reports."""
    out = []
    if f"temp_{test.axis.lower()}_C" not in test.further:
        out.append(f"temperature of the scale of {test.axis}: U assumes 15 to 25 °C")
    if test.quantity == "length" and not {"temp_air_C", "pressure_air_Pa"} <= set(test.further):
        out.append("temperature and pressure of the air, for the wavelength: U assumes 15 to 25 °C, 980 to 1040 hPa")
    if test.quantity == "length":
        out.append(MATERIAL_UNKNOWN)
    if test.feed_mm_min is None:
        out.append("feed")
    if test.t_s is None:
        out.append("times of the readings: t_s is the number of each reading in order")
    out.append("positions of the other axes: 0 is written")
    return out


def laser_of(tests: Sequence[AxisReadings]) -> dict[str, float]:
    """Return the laser of the campaign file: coarsest resolution of the tests, and larger uncertainties for unknown temperatures or air."""
    out = {"resolution_mm": max(test.resolution for test in tests)}
    if any(f"temp_{test.axis.lower()}_C" not in test.further for test in tests):
        out["u_scale_temperature_k"] = float(U_SCALE_TEMPERATURE_K)
    if any(not {"temp_air_C", "pressure_air_Pa"} <= set(test.further) for test in tests):
        out["u_wavelength"] = U_WAVELENGTH
    return out
