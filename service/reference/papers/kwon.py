"""Kwon: comparisons for kinematics, text, and the printed coefficients and sums of Tables 1 and 2."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from abbe.models.arrays import F1
from abbe.models.papers.kwon.forensics import (
    GridSums,
    ImpliedPlane,
    grid_sums,
    implied_plane,
    in_plane_coefficients,
    in_plane_label,
    ladder_name,
    square_grid,
)
from abbe.models.papers.kwon.kinematics import Geometry, forward, forward_as_printed, inverse, links, square_commands
from abbe.models.papers.kwon.layout import CUBIC, IN_PLANE, layout
from abbe.models.papers.kwon.surface import anova_from_sums, critical_f
from abbe.service.reference.comparison import Comparison, Erratum, stated
from abbe.service.reference.papers import kwon_printed as paper
from abbe.service.reference.printed import Computed, Given, Printed, agrees, computed_from, values
from abbe.service.reference.text import minus

IK_BOUND_MM = 1e-7
"""Largest deviation of the inverse kinematics from the commands of the example in math.md."""

ALPHA = 0.01
GRID = "9 × 9 points, steps of 0.25 mm as printed, ± 1 mm assumed from the stroke of 2 mm and the 82 points of the text"
_POWERS = ("", "", "²", "³")
NO_POINTS = "needs the errors at the grid points, which are not printed"
COEFFICIENTS = "rounding of the 20 printed coefficients"
DAMAGED_ROW = (paper.COMPONENTS.index(paper.DAMAGED[0]), paper.DAMAGED[1])


def comparisons() -> list[Comparison]:
    """Return the comparisons of every number of the paper, in printed order, and the round trip of the kinematics."""
    tables = (_plane, _coefficients, _in_plane, _sums, _largest, _variance, _degrees_of_freedom)
    return [*_kinematics(), *_text(), *(c for table in tables for c in table()), *_round_trip()]


def assumed_geometry() -> Geometry:
    """Return the geometry that math.md 6 assumes for its example."""
    g = paper.GEOMETRY_MM
    legs = {"R_mm": np.array(g["R"]), "r_mm": np.array(g["r"]), "l_mm": np.array(g["l"])}
    return Geometry(**legs, l_up_mm=g["l_up"], l_dw_mm=g["l_dw"], theta_rad=float(np.deg2rad(paper.GEOMETRY_DEG)), le_mm=g["le"])


def _kinematics() -> list[Comparison]:
    geometry = assumed_geometry()
    out = []
    for command, numbers in paper.EXAMPLES:
        at = forward(geometry, np.array([command]))
        how = "forward with the geometry that math.md assumes"
        out += _point(f"ball centre at λ = {_list(command)}", numbers, at[0], how)
    wrong = forward_as_printed(geometry, np.array([paper.EXAMPLES[1][0]]))
    how = "forward_as_printed: eq (4) without the factor 1/2"
    out += _point("ball centre by (4) as printed", paper.EXAMPLE_WITHOUT_HALF, wrong[0], how)
    lengths = np.linalg.norm(links(geometry, np.array([paper.EXAMPLES[1][0]]), wrong)[0], axis=1)
    how = f"links at that point: their lengths differ from {paper.GEOMETRY_MM['l']} mm, so (4) as printed breaks its own constraint"
    out += [
        stated("6", f"link {k} at that point", "mm", number, float(value), how)
        for k, (number, value) in enumerate(zip(paper.LINKS_WITHOUT_HALF, lengths, strict=True), 1)
    ]
    ends = square_commands(geometry, 1.0, float(forward(geometry, np.array([paper.EXAMPLES[0][0]]))[0, 2]))
    how = "square_commands with the assumed geometry: more than the stated stroke of 2 mm; the actual geometry is not printed"
    return out + [
        stated("6", f"{name} λ for a square of ± 1 mm", "mm", number, value, how)
        for name, number, value in zip(("smallest", "largest"), paper.SQUARE_COMMANDS_MM, ends, strict=True)
    ]


def _round_trip() -> list[Comparison]:
    """Check that the inverse kinematics return the commands whose ball centre math.md states."""
    command, there = paper.EXAMPLES[1]
    back = inverse(assumed_geometry(), np.array([[p.value for p in there]]))[0]
    how = "inverse of the ball centre that math.md states, with the geometry that math.md assumes"
    why = (
        f"math.md 6: the inverse kinematics return λ. Bound {IK_BOUND_MM:g} mm: math.md states nine decimals of the ball centre, and the"
        " rows of the ball centre show how far the last decimals are off"
    )
    series = "back from the ball centre"
    return [
        Comparison(
            *("math.md 6", f"λ{k} {series}", "mm", Given(given, IK_BOUND_MM), Computed(float(value)), how, why),
            series=f"λ {series}",
            source="own check",
        )
        for k, (given, value) in enumerate(zip(command, back, strict=True), 1)
    ]


def _point(name: str, numbers: tuple[Printed, ...], point: F1, how: str) -> list[Comparison]:
    return [
        stated("6", f"{name}, {axis}", "mm", number, float(value), how) for axis, number, value in zip("xyz", numbers, point, strict=True)
    ]


def _list(values: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{v:g}" for v in values) + ")"


def _text() -> list[Comparison]:
    raw = "the coordinates measured on the CMM (Figs. 9, 10) are not printed"
    repeated = "the repeated readings (Fig. 14) are not printed"
    sd = ", ".join(f"{1e3 * np.sqrt(row[1].value):.1f}" for row in paper.TABLE2_MEAN_SQUARES.values())
    residual = f"the residuals (Fig. 13) are not printed. The mean squares of Table 2 correspond to standard deviations of {sd} µm"
    return [
        Comparison("4.2", "turn about Z before referencing", "°", paper.TURN_BEFORE_DEG, why=raw),
        Comparison("4.2", "turn about Z afterwards", "°", paper.TURN_AFTER_DEG, why=raw),
        Comparison("4.2", "residuals within ±", "µm", paper.RESIDUAL_UM, why=residual),
        *(
            Comparison("4.2", f"repeatability of {axis}, ±", "µm", number, why=repeated, series="repeatability ± of x, y, z")
            for axis, number in paper.REPEATABILITY_UM.items()
        ),
    ]


@cache
def plane() -> ImpliedPlane:
    """Return the plane on which the coefficients of Table 1 were fitted, from all quotients without the damaged coefficient."""
    return implied_plane(np.array([values(paper.TABLE1[c]) for c in paper.COMPONENTS]), leave_out=(DAMAGED_ROW,))


def restored(component: str) -> tuple[Printed, ...]:
    """Return the coefficients of a component with the damaged exponent restored."""
    numbers = paper.TABLE1[component]
    if component != paper.DAMAGED[0]:
        return numbers
    k = paper.DAMAGED[1]
    return (*numbers[:k], paper.RESTORED, *numbers[k + 1 :])


def in_plane(component: str, z_mm: float) -> F1:
    """Return the coefficients of a component as a cubic of x and y on a plane, in the order of IN_PLANE."""
    return in_plane_coefficients(np.array(values(restored(component))), z_mm)


def _plane() -> list[Comparison]:
    found = plane()
    wrong = Erratum("Table 1 is the minimum-norm solution of a fit on another plane; perhaps Z had another origin")
    how = "implied_plane: median of the quotients of neighbouring coefficients"
    ratios = np.array([r for _, r in found.ratios_mm])
    why = f"{ratios.size} quotients between {ratios.min():.2f} and {ratios.max():.2f} mm, {paper.PLANE_Z_MM.value - found.z_mm:.2f} mm off"
    out = [
        Comparison("Table 1", "plane Z of the fit", "mm", paper.PLANE_Z_MM, Computed(found.z_mm), how, why, wrong),
        stated("6", "plane Z of the fit", "mm", paper.MATH_PLANE_MM, found.z_mm, how),
        stated("6", "spread of the quotients", "mm", paper.MATH_SPREAD_MM, found.sd_mm, how),
    ]
    for (component, up, low), _ in found.ratios_mm:
        numbers = paper.TABLE1[paper.COMPONENTS[component]]
        ratio = computed_from(_ratio, numbers[up], numbers[low])
        name = f"β{up}/β{low} ({ladder_name((up, low))}) of {paper.COMPONENTS[component]}"
        by_ratio = Comparison("Table 1", f"plane Z by {name}", "mm", paper.PLANE_Z_MM, ratio, how, erratum=wrong, again=True)
        out.append(replace(by_ratio, series="plane Z by quotients"))
    return out


def _coefficients() -> list[Comparison]:
    component, k = paper.DAMAGED
    number = paper.TABLE1[component][k]
    factor = plane().z_mm
    below = next(low for (c, up, low), _ in _all_pairs() if up == k and c == DAMAGED_ROW[0])
    value = factor * paper.TABLE1[component][below].value
    how = f"β{below} of {component} times the implied Z"
    power = Erratum("printed with 10⁻³ instead of 10⁻⁵", computed_from(lambda b: 100.0 * factor * b, paper.TABLE1[component][below]))
    out = [Comparison("Table 1", f"β{k} of {component}", "mm/mm³", number, Computed(value), how, "exponent", power)]
    for c in paper.COMPONENTS:
        for i, coefficient in enumerate(paper.TABLE1[c]):
            if (c, i) != paper.DAMAGED:
                unit = f"mm/mm{_POWERS[sum(CUBIC[i])]}" if i else "mm"
                out.append(Comparison("Table 1", f"β{i} of {c}", unit, coefficient, why=NO_POINTS, series=f"coefficients of {c}"))
    return out


def _all_pairs() -> tuple[tuple[tuple[int, int, int], float], ...]:
    """Return all quotients of `LADDER` in Table 1, including damaged ones."""
    return implied_plane(np.array([values(paper.TABLE1[c]) for c in paper.COMPONENTS])).ratios_mm


def _in_plane() -> list[Comparison]:
    how = f"in_plane_coefficients of Table 1 at Z = {plane().z_mm:.5f} mm, β10 of e_x restored"
    out = []
    for c in paper.COMPONENTS:
        found = in_plane(c, plane().z_mm)
        for term, number, value in zip(IN_PLANE, paper.MATH_IN_PLANE[c], found, strict=True):
            name = f"in-plane cubic of {c}"
            row = stated("6", f"{name}, {in_plane_label(term)}", "mm", number, float(value), how)
            out.append(replace(row, series=name))
    return out


def _on_grid(component: str, z_mm: float, figure: Callable[[GridSums], float]) -> Computed:
    """Return ``figure`` of a component's sums over the 9 x 9 grid; the allowance covers the rounding of the coefficients."""

    def of(*beta: float) -> float:
        return figure(grid_sums(in_plane_coefficients(np.array(beta), z_mm)))

    return computed_from(of, *restored(component), because=COEFFICIENTS)


def _sums() -> list[Comparison]:
    grid = f"grid_sums about the mean, {GRID}"
    used, other = plane().z_mm, paper.PLANE_Z_MM.value
    out = []
    for c in paper.COMPONENTS:
        number = paper.TABLE2_SUMS[c][0]
        here, there = (_on_grid(c, z, lambda s: s.ss_mean) for z in (used, other))
        share = minus(f"{100.0 * (here.value - number.value) / number.value:+.2f}")
        why = f"{share} % off. Table 1 and Table 2 check each other: N = 81, coordinates in mm (± 1 mm, assumed), sums about the mean"
        how, how_other = (f"{grid}, Table 1 at Z = {z:.3f} mm" for z in (used, other))
        quantity = f"regression sum of squares of {c}"
        no_fit = "the sums do not fit at the plane that the paper states: it is not the plane of the fit"
        out += [
            Comparison("Table 2", quantity, "mm²", number, here, how, why),
            Comparison("Table 2", f"{quantity}, printed Z", "mm²", number, there, how_other, no_fit, again=True),
            stated("6", quantity, "mm²", paper.MATH_SUMS[c], here.value, how),
            stated("6", f"{quantity}, printed Z", "mm²", paper.MATH_SUMS_PRINTED_Z[c], there.value, how_other),
        ]
    return out


def _largest() -> list[Comparison]:
    out = []
    used = plane().z_mm
    how = f"largest value on {GRID}, Table 1 at Z = {used:.3f} mm"
    for c in paper.COMPONENTS:
        number = paper.LARGEST_UM[c]
        found = _on_grid(c, used, lambda s: 1e3 * s.largest)
        near = abs(found.value - number.value) <= paper.RESIDUAL_UM.value
        why = (
            f"within the stated residuals of ± {paper.RESIDUAL_UM.text} µm, if the paper took its figure from the readings"
            if near
            else f"beyond the stated residuals of ± {paper.RESIDUAL_UM.text} µm: Table 1 does not give the figure of the text"
        )
        out.append(Comparison("4.2", f"largest |{c}|", "µm", number, found, how, why))
        out.append(stated("6", f"largest |{c}|", "µm", paper.MATH_LARGEST_UM[c], found.value, how))
    return out


def _variance() -> list[Comparison]:
    out = []
    for c in paper.COMPONENTS:
        regression, residual, total = paper.TABLE2_SUMS[c]
        sum_of_both = computed_from(lambda a, b: a + b, regression, residual)
        out += [
            Comparison("Table 2", f"residual sum of squares of {c}", "mm²", residual, why=NO_POINTS),
            Comparison("Table 2", f"total sum of squares of {c}", "mm²", total, sum_of_both, "regression + residual"),
            *_mean_squares(c, regression, residual),
            _f(c, regression, residual),
        ]
        right = anova_from_sums(regression.value, residual.value, *degrees_of_freedom()).f
        how = "anova_from_sums of the printed sums with the degrees of freedom of the grid"
        out.append(stated("6", f"F of {c}, 9 and 71 degrees of freedom", "", paper.MATH_F[c], right, how))
    return out


def _over_61(c: str) -> bool:
    """Return whether the residual mean square of a component results from a division by 61 and not by the printed 60."""
    residual, printed = paper.TABLE2_SUMS[c][1], paper.TABLE2_MEAN_SQUARES[c][1]
    n = int(paper.DOF_RESIDUAL.value)
    by_60, by_61 = computed_from(lambda s: s / n, residual), computed_from(lambda s: s / (n + 1), residual)
    return not agrees(by_60, printed) and agrees(by_61, printed)


def _mean_squares(c: str, regression: Printed, residual: Printed) -> list[Comparison]:
    of_regression, of_residual = paper.TABLE2_MEAN_SQUARES[c]
    k, n = int(paper.DOF_REGRESSION.value), int(paper.DOF_RESIDUAL.value)
    other = Erratum(f"divided by {n + 1} instead of the printed {n} here", computed_from(lambda s: s / (n + 1), residual))
    in_regression = computed_from(lambda s: s / k, regression)
    why = "" if agrees(in_regression, of_regression) else "sum and mean square of the same line do not belong together"
    in_residual = computed_from(lambda s: s / n, residual)
    slip = other if _over_61(c) else None
    return [
        Comparison("Table 2", f"mean square of the regression of {c}", "mm²", of_regression, in_regression, f"regression sum / {k}", why),
        Comparison("Table 2", f"mean square of the residual of {c}", "mm²", of_residual, in_residual, f"residual sum / {n}", erratum=slip),
    ]


def _f(c: str, regression: Printed, residual: Printed) -> Comparison:
    k, n = int(paper.DOF_REGRESSION.value), int(paper.DOF_RESIDUAL.value)
    found = computed_from(lambda a, b: anova_from_sums(a, b, k, n).f, regression, residual)
    number = paper.TABLE2_F[c]
    how = f"anova_from_sums of the printed sums with the printed {k} and {n} degrees of freedom"
    erratum, why = None, ""
    if not agrees(found, number):
        ratio = computed_from(_ratio, *paper.TABLE2_MEAN_SQUARES[c])
        if _over_61(c):
            by_61 = computed_from(lambda a, b: anova_from_sums(a, b, k, n + 1).f, regression, residual)
            why = f"divisor; the ratio of the printed mean squares is {_interval(ratio)}"
            erratum = Erratum(f"residual divided by {n + 1} instead of the printed {n}, as in its mean square", by_61)
        else:
            why = f"unexplained. Nearest is the ratio of the printed mean squares, {_interval(ratio)}"
            erratum = Erratum("the paper divides the printed mean squares, not those computed from the sums", ratio)
    return Comparison("Table 2", f"F of {c}", "", number, found, how, why, erratum)


def _ratio(a: float, b: float) -> float:
    return a / b


def _interval(found: Computed) -> str:
    low, high = found.value - found.allowance, found.value + found.allowance
    return f"{found.value:.2f} ({low:.2f} to {high:.2f} with the rounding of both)"


def degrees_of_freedom() -> tuple[int, int]:
    """Return the degrees of freedom of regression and residual on the paper's grid: rank - 1 and points - rank."""
    found = layout(square_grid(step_mm=paper.STEP_MM.value, z_mm=plane().z_mm))
    return found.rank - 1, found.n - found.rank


def _degrees_of_freedom() -> list[Comparison]:
    regression, residual = degrees_of_freedom()
    points = regression + residual + 1
    grid = f"layout of the grid on one plane, {GRID}"
    counted = Erratum(
        "the paper counts its 20 coefficients; on one plane only 10 are independent, and one is the mean", Computed(float(len(CUBIC)))
    )
    left = Erratum("81 points − 1 − 20", Computed(float(points - 1 - len(CUBIC))))
    k, n = int(paper.DOF_REGRESSION.value), int(paper.DOF_RESIDUAL.value)
    more = "the sums of Table 2 and 20 + 60 + 1 = 81 say 9 × 9 points"
    degrees, of_grid = "degrees of freedom of the", critical_f(regression, residual, ALPHA)
    return [
        Comparison("Table 2", f"{degrees} regression", "", paper.DOF_REGRESSION, Computed(float(regression)), grid, "rank", counted),
        Comparison("Table 2", f"{degrees} residual", "", paper.DOF_RESIDUAL, Computed(float(residual)), grid, "rank", left),
        Comparison("4.2", "grid points", "", paper.POINTS, Computed(float(points)), grid, more),
        Comparison("4.2", f"critical F({k}, {n}, {ALPHA})", "", paper.CRITICAL_F, Computed(critical_f(k, n, ALPHA)), "critical_f"),
        stated("6", f"critical F({regression}, {residual}, {ALPHA})", "", paper.MATH_CRITICAL_F, of_grid, "critical_f"),
    ]
