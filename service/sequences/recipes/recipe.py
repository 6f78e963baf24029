"""Recipes: the parameters of a test; `plan` turns them into steps.

Every axis approaches the first position in the direction of its first motion, so that its lost motion is in a known state at the start; an
axis that begins at the very end of its stroke cannot. A test that mounts something clears it away at the end.
"""

from __future__ import annotations

from abbe.service.sequences.recipes.approach import RAPID_MM_MIN, as_point
from abbe.service.sequences.recipes.bar_recipes import MIN_TURNS, BarRecipe, Circle, Helix, HelixPoints
from abbe.service.sequences.recipes.laser_recipes import Diagonal, FaceDiagonal, LaserRecipe, Linear

__all__ = [
    "MIN_TURNS", "RAPID_MM_MIN", "BarRecipe", "Circle", "Diagonal", "FaceDiagonal", "Helix", "HelixPoints", "LaserRecipe", "Linear",
    "Recipe", "as_point",
]  # fmt: skip

Recipe = BarRecipe | LaserRecipe
