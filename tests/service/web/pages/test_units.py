"""One function for every length on a screen."""

from __future__ import annotations

import pytest

from abbe.service.rendering.numbers import MM, placed
from abbe.service.web.pages.budget import _interval
from abbe.service.web.units import INCH, METRIC, converted, drawn_in, rounded, shown, unit_in


@pytest.mark.parametrize(
    ("value", "unit", "system", "text"),
    [
        (25.4, "µm", INCH, "1000"),
        (0.0254, "µm", INCH, "1.0"),
        (25.4, "mm", INCH, "1.0"),
        (12.34, "µm", METRIC, "12.3"),
        (None, "µm", INCH, "–"),
        (21.5, "°C", INCH, "21.5"),
        # Already rounded: the same number, with a step as fine as before.
        ("12.34", "µm", METRIC, "12.34"),
        ("12.34", "µm", INCH, "485.8"),
        ("+2.54", "µm", INCH, "+100.0"),
        ("-2.54", "µm", INCH, "-100.0"),
        ("100", "µm", INCH, "3937"),
        ("254", "mm", INCH, "10.00"),
        ("n/a", "µm", INCH, "n/a"),
        ("3", "", INCH, "3"),
        ("6000", "mm/min", INCH, "236.22"),
        (6000.0, "mm/min", INCH, "236"),
        (12.34, "µm/m", INCH, "12.3"),
    ],
)
def test_a_length_is_shown_in_the_readers_unit(value: float | str | None, unit: str, system: str, text: str) -> None:
    assert shown(value, unit, system) == text


@pytest.mark.parametrize(
    ("value_mm", "inch", "mm"),
    [
        (2543.17526, "100.125", "2543.175"),  # what toFixed of the 3-D map says
        (25400.0 / 3, "333.3333", "8466.667"),
        (66.66667, "2.6247", "66.667"),
        (600.0, "23.622", "600"),
        (-254.0, "−10", "−254"),
        (0.0, "0", "0"),
        (float("nan"), "n/a", "n/a"),
    ],
)
def test_a_place_is_as_fine_far_out_as_near(value_mm: float, inch: str, mm: str) -> None:
    assert (placed(value_mm, drawn_in("mm", INCH)), placed(value_mm, MM)) == (inch, mm)


@pytest.mark.parametrize(("value", "expanded"), [(float("nan"), 2.0), (float("inf"), 2.0), (1.0, float("nan")), (1.0, float("inf"))])
def test_an_interval_of_what_is_no_number_is_not_available(value: float, expanded: float) -> None:
    line = _interval("dX", value, expanded, "µm")
    assert (line.ends, "n/a" in line.shown) == (("n/a", "n/a"), True)


def test_units_and_factors() -> None:
    assert [unit_in(u, INCH) for u in ("µm", "mm", "mm/min", "µrad", "µm/m", "")] == ["µin", "in", "in/min", "µrad", "µm/m", ""]
    assert [drawn_in(u, INCH).size for u in ("µm", "mm", "mm/min", "µm/m")] == [0.0254, 25.4, 25.4, 1.0]
    assert [unit_in(u, METRIC) for u in ("µm", "mm")] == ["µm", "mm"]
    assert converted(25.4, "mm", INCH) == pytest.approx(1.0, rel=1e-15)
    assert converted(1.0, "µm", INCH) == pytest.approx(39.37007874015748, rel=1e-15)
    assert converted(1.0, "µm", METRIC) == 1.0


def test_a_number_keeps_the_resolution_it_has_in_mm() -> None:
    assert [shown(97.7, "mm", system, 0) for system in (METRIC, INCH)] == ["98", "3.85"]  # not 98 / 25.4
    assert [shown(0.46, "µm", system, 1) for system in (METRIC, INCH)] == ["0.5", "18"]
    assert shown(None, "mm", INCH, 1) == "–"


@pytest.mark.parametrize(
    ("value", "u", "unit", "pair"),
    [
        (12.34, 0.6, "µm", ("486", "47")),
        (12.34, 6.0, "µm", ("490", "470")),  # U rounds to tens, and so does the value
        (-0.5, 0.025, "mm", ("−0.0197", "0.0020")),
        (-12.34, 0.6, "µm/m", ("−12.3", "1.2")),
        (12.7, None, "µm", ("500", "n/a")),
        (None, None, "µm", ("n/a", "n/a")),
    ],
)
def test_value_and_u_are_rounded_in_the_unit_that_is_read(value: float | None, u: float | None, unit: str, pair: tuple[str, str]) -> None:
    assert rounded(value, u, unit, INCH) == pair
