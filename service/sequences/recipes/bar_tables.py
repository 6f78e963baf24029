"""Ball-bar tests in a recipe file: ``helix``, ``helix_points`` and ``circle``."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from abbe.models.machine import AXES
from abbe.service.sequences.recipes.bar_recipes import BarRecipe, Circle, Helix, HelixPoints
from abbe.service.sequences.recipes.recipe_tables import Coordinate, Feed, Letter, Settle, TestTable

Arc = Annotated[float, Field(ge=0.0, le=360.0)]
Turns = Annotated[float, Field(ge=3.0, le=50.0)]


class CupTable(TestTable):
    """Keys of every ball-bar test."""

    centre_mm: tuple[Coordinate, Coordinate, Coordinate]
    radius_mm: Annotated[float, Field(ge=0.1, le=2000.0)]
    axis: Letter = "Z"
    opens: Literal[1, -1] = 1
    direction: Literal[1, -1] = 1
    rate_hz: Annotated[int, Field(ge=1, le=1000)] = 100
    length_calibrated: bool = True
    u_length_mm: Annotated[float, Field(ge=0.0, le=1.0)] = 0.002

    @field_validator("rate_hz")
    @classmethod
    def _divides(cls, rate_hz: int) -> int:
        if 1000 % rate_hz:
            raise ValueError(f"expected a rate that divides 1000 Hz (1000, 500, 250, 200, 125, 100, 50 ...), got {rate_hz}")
        return rate_hz

    def common(self) -> dict[str, Any]:
        """Arguments that all ball-bar recipes take."""
        own = self.model_dump(include=set(CupTable.model_fields) - {"setup", "axis"})
        return own | {"setup_id": self.setup, "axis": AXES.index(self.axis)}


class HelixTable(CupTable):
    """One ``[[test]]`` of kind helix."""

    kind: Literal["helix"]
    turns: Turns = 5.0
    law: Literal["area", "angle"] = "area"
    feed_mm_min: Feed = 2000.0
    feed_in_deg: Annotated[float, Field(ge=0.0, le=90.0)] = 0.0
    feed_out_deg: Annotated[float, Field(ge=0.0, le=90.0)] = 0.0

    def recipe(self) -> Helix:
        """The recipe, mounting and clearing away by itself."""
        return Helix(
            **self.common(),
            turns=self.turns,
            law=self.law,
            feed_mm_min=self.feed_mm_min,
            feed_in_deg=self.feed_in_deg,
            feed_out_deg=self.feed_out_deg,
        )


class HelixPointsTable(CupTable):
    """One ``[[test]]`` of kind helix_points: the helix read at standstill, place by place."""

    kind: Literal["helix_points"]
    turns: Turns = 5.0
    law: Literal["area", "angle"] = "area"
    points: Annotated[int, Field(ge=20, le=2000)] = 120
    feed_mm_min: Feed = 2000.0
    rate_hz: Annotated[int, Field(ge=1, le=1000)] = 1000
    settle_s: Settle = 0.3
    samples: Annotated[int, Field(ge=1, le=1000)] = 20

    def recipe(self) -> HelixPoints:
        """The recipe, mounting and clearing away by itself."""
        own = {k: getattr(self, k) for k in ("turns", "law", "points", "feed_mm_min", "settle_s", "samples")}
        return HelixPoints(**self.common(), **own)


class CircleTable(CupTable):
    """One ``[[test]]`` of kind circle; angles count from the plane's first axis to its second."""

    kind: Literal["circle"]
    plane: Literal["XY", "YZ", "ZX"]
    start_deg: Annotated[float, Field(ge=-360.0, le=360.0)] | None = None
    span_deg: Annotated[float, Field(ge=30.0, le=720.0)] | None = None
    feed_in_deg: Arc | None = None
    feed_out_deg: Arc | None = None
    under_the_cup: bool = False
    feed_mm_min: Feed = 1000.0

    def recipe(self) -> Circle:
        """The recipe, mounting and clearing away by itself."""
        own = {
            k: getattr(self, k) for k in ("plane", "start_deg", "span_deg", "feed_in_deg", "feed_out_deg", "feed_mm_min", "under_the_cup")
        }
        return Circle(**self.common(), **own)


KINDS: dict[str, type[TestTable]] = {"helix": HelixTable, "helix_points": HelixPointsTable, "circle": CircleTable}


def bar_table(recipe: BarRecipe) -> dict[str, Any]:
    """The keys of a ball-bar recipe as they stand in a file."""
    cup = {"centre_mm": list(recipe.centre_mm), "radius_mm": recipe.radius_mm, "axis": AXES[recipe.axis], "opens": recipe.opens}
    rest = {"direction": recipe.direction, "feed_mm_min": recipe.feed_mm_min, "rate_hz": recipe.rate_hz}
    rest |= {"length_calibrated": recipe.length_calibrated, "u_length_mm": recipe.u_length_mm}
    if isinstance(recipe, Circle):
        own: dict[str, Any] = {"plane": recipe.plane}
        own |= {k: v for k in recipe.arc() if (v := getattr(recipe, k)) is not None}
        own |= {"under_the_cup": True} if recipe.under_the_cup else {}
        return {"kind": "circle"} | cup | own | rest
    own = {"turns": recipe.turns, "law": recipe.law}
    if isinstance(recipe, HelixPoints):
        own |= {"points": recipe.points, "settle_s": recipe.settle_s, "samples": recipe.samples}
        return {"kind": "helix_points"} | cup | own | rest
    arcs = {"feed_in_deg": recipe.feed_in_deg, "feed_out_deg": recipe.feed_out_deg}
    return {"kind": "helix"} | cup | own | {k: v for k, v in arcs.items() if v} | rest
