"""Built-in campaigns, scaled to any machine's strokes.

The identification campaign lets the joint solution determine every error that nine tables can correct: helices about five centres,
each axis on two opposite edges, step diagonals in two step orders (math.md 5.5: rank 67 of 67 for translations and one-tool angles).
The verification uses positions that the identification does not use.
"""

from __future__ import annotations

import numpy as np

from abbe.models.machine import AXES, Machine
from abbe.models.paths.lines import DIAGONALS
from abbe.service.sequences.recipes.recipe import Diagonal, Helix, Linear, Recipe, as_point
from abbe.service.sequences.steps import CampaignPlan, Point


def hemisphere(machine: Machine, rel: tuple[float, float, float], share: float) -> tuple[Point, float]:
    """Return the centre at relative position ``rel`` and ``share`` times the largest radius (whole mm) whose upper hemisphere fits."""
    centre = machine.stroke_mm[:, 0] + np.array(rel) * machine.length_mm
    below = centre - machine.stroke_mm[:, 0]
    above = machine.stroke_mm[:, 1] - centre
    room = min(below[0], above[0], below[1], above[1], above[2]) - 5.0
    return as_point(np.round(centre)), float(max(20.0, np.floor(share * room)))


def identification(machine: Machine, *, rate_hz: int = 100, name: str = "identify") -> CampaignPlan:
    """Five helices, six lines, eight step diagonals: about 22 minutes of machine time for a 600 x 500 x 450 mm machine."""
    recipes: list[Recipe] = []
    places = [(0.5, 0.5, 0.3), (0.32, 0.36, 0.2), (0.68, 0.64, 0.2), (0.32, 0.64, 0.25), (0.68, 0.36, 0.25)]
    for k, rel in enumerate(places):
        centre, radius = hemisphere(machine, rel, 0.85 if k == 0 else 0.95)
        recipes.append(Helix(f"helix{k + 1}", f"B{k + 1}", "identify", centre, radius, rate_hz=rate_hz))
    for a in range(3):
        for k, at in enumerate((0.15, 0.85)):
            recipes.append(Linear(f"line{AXES[a]}{k + 1}", f"L{AXES[a]}{k + 1}", "identify", a, at_share=(at, at)))
    for order in ("XYZ", "ZYX"):
        recipes += [Diagonal(f"step-{d}-{order}", f"D{d}{order}", "identify", d, 12, order) for d in DIAGONALS]
    return CampaignPlan(name, tuple(r.plan(machine) for r in recipes))


def verification(machine: Machine, *, rate_hz: int = 100, name: str = "verify", role: str = "holdout") -> CampaignPlan:
    """One helix (with a centre and radius that the identification does not use) and the four plain body diagonals."""
    recipes: list[Recipe] = [verification_helix(machine, rate_hz=rate_hz, role=role)]
    recipes += [Diagonal(f"check-{d}", f"V{d}", role, d, 20, "") for d in DIAGONALS]
    return CampaignPlan(name, tuple(r.plan(machine) for r in recipes))


def verification_helix(machine: Machine, *, rate_hz: int = 100, role: str = "holdout") -> Helix:
    """The helix of the verification."""
    centre, radius = hemisphere(machine, (0.45, 0.55, 0.12), 0.7)
    return Helix("check-helix", "VB", role, centre, radius, turns=4, rate_hz=rate_hz)


def quick_check(machine: Machine, *, rate_hz: int = 100, name: str = "quick-check") -> CampaignPlan:
    """The unattended check: the tests of the verification with half the positions, a few minutes of machine time."""
    centre, radius = hemisphere(machine, (0.45, 0.55, 0.12), 0.7)
    recipes: list[Recipe] = [Helix("check-helix", "VB", "holdout", centre, radius, turns=3, rate_hz=rate_hz)]
    recipes += [Diagonal(f"check-{d}", f"V{d}", "holdout", d, 10, "") for d in DIAGONALS]
    return CampaignPlan(name, tuple(r.plan(machine) for r in recipes))
