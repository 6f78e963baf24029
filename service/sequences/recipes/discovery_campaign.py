"""The campaign of the discovery demonstration: it separates most candidate effects in one session (effects.md 4)."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from abbe.models.machine import AXES, Machine
from abbe.models.paths.lines import DIAGONALS
from abbe.service.sequences.recipes.campaigns import hemisphere, verification, verification_helix
from abbe.service.sequences.recipes.recipe import Diagonal, Helix, Linear, Recipe
from abbe.service.sequences.steps import CampaignPlan

SLOW, MIDDLE, FAST = 1000.0, 2000.0, 3000.0
STEPS, LINE_N = 12, 13
JUDGED = "pnp"
BACK = "check-back"
CHORD_MM = 0.5
"""The position of a sample on its path is known to half a sampling period, 0.3 mm at 50 Hz and 2000 mm/min. By the area law the usual
chords are 1 mm long at the equator and 3 mm at the pole, and run 0.9 and 10 um inside the sphere: misplaced readings scatter there, and a
clean machine seems disturbed. Even chords of 0.4 mm run at most 0.24 um inside."""
ROUND: tuple[Literal[1, -1], ...] = (1, -1)


def discovery_campaign(machine: Machine, *, rate_hz: int = 100, name: str = "discover") -> CampaignPlan:
    """Helices at two feeds both ways about one origin, both ways about another, step diagonals; late repeats of the axes and first origin.

    About 20 minutes of machine time for a 600 x 500 x 450 mm machine. A late helix of another feed and the second step order of a diagonal
    have the role holdout: they share a mounting with fitted runs, so that only the model can cause their deviation.
    """
    first = _helix(machine, "A", (0.5, 0.5, 0.3), 0.6, rate_hz)
    second = _helix(machine, "B", (0.34, 0.38, 0.2), 0.65, rate_hz)
    recipes: list[Recipe] = _lines(machine, "early")
    recipes += [*_series(first, "a", [(f, d, "identify") for f in (SLOW, FAST) for d in ROUND])]
    recipes += _series(second, "b", [(MIDDLE, d, "identify") for d in ROUND])
    for diagonal in DIAGONALS:
        judged = diagonal == JUDGED
        recipes.append(Diagonal(f"step-{diagonal}", f"D{diagonal}", "identify", diagonal, STEPS, "XYZ", unmount=not judged))
        if judged:
            recipes.append(Diagonal(f"judge-{diagonal}", f"D{diagonal}", "holdout", diagonal, STEPS, "ZYX", mount=False))
    late = replace(first, setup_id="L")
    recipes += _series(late, "late", [(MIDDLE, 1, "identify"), (SLOW, -1, "identify"), (0.5 * (MIDDLE + FAST), 1, "holdout")])
    recipes += _lines(machine, "late")
    return CampaignPlan(name, tuple(r.plan(machine) for r in recipes))


def new_measurement(machine: Machine, *, rate_hz: int = 100, name: str = "anew") -> CampaignPlan:
    """The verification, with its helix also run back slowly with the bar left in: the difference shows what changes while a bar hangs.

    One helix alone cannot tell a constantly warm bar from a longer one.
    """
    plan = verification(machine, rate_hz=rate_hz, name=name)
    check = replace(verification_helix(machine, rate_hz=rate_hz), chord_mm=CHORD_MM, even=True)
    there = replace(check, unmount=False)
    back = replace(check, label=BACK, feed_mm_min=SLOW, direction=-1, mount=False)
    return CampaignPlan(name, (there.plan(machine), back.plan(machine), *plan.tests[1:]))


def _lines(machine: Machine, when: str) -> list[Recipe]:
    """One line per axis: its length shows growth during the session, independent of squareness."""
    return [
        Linear(f"{when}-line{AXES[a]}", f"{when}{AXES[a]}", "identify", a, at_share=(0.5, 0.5), positions=LINE_N)
        for a in range(len(machine.stroke_mm))
    ]


def _helix(machine: Machine, setup: str, rel: tuple[float, float, float], share: float, rate_hz: int) -> Helix:
    centre, radius = hemisphere(machine, rel, share)
    return Helix("", setup, "identify", centre, radius, turns=4, rate_hz=rate_hz, chord_mm=CHORD_MM, even=True)


def _series(like: Helix, name: str, ways: list[tuple[float, Literal[1, -1], str]]) -> list[Recipe]:
    """Consecutive helices with one mounting of the bar."""
    last = len(ways) - 1
    return [
        replace(like, label=_label(name, feed, way), role=role, feed_mm_min=feed, direction=way, mount=k == 0, unmount=k == last)
        for k, (feed, way, role) in enumerate(ways)
    ]


def _label(name: str, feed: float, way: int) -> str:
    return f"{name}-{feed:.0f}-{'out' if way > 0 else 'back'}"
