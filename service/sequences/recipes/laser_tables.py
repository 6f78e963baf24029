"""Laser tests in a recipe file: ``diagonal``, ``face`` and ``line``."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from abbe.models.machine import AXES
from abbe.service.sequences.recipes.approach import RAPID_MM_MIN
from abbe.service.sequences.recipes.laser_recipes import Diagonal, FaceDiagonal, LaserRecipe, Linear
from abbe.service.sequences.recipes.recipe_tables import Feed, Letter, Settle, Share, TestTable

Order = Literal["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"]
Steps = Annotated[int, Field(ge=1, le=500)]


class BeamTable(TestTable):
    """Keys of every laser test."""

    feed_mm_min: Feed = RAPID_MM_MIN
    settle_s: Settle = 0.3
    cycles: Annotated[int, Field(ge=1, le=50)] = 1
    overrun_mm: Annotated[float, Field(ge=0.0, le=8.0)] = 0.0

    def common(self) -> dict[str, Any]:
        """Arguments that all laser recipes take."""
        return self.model_dump(include=set(BeamTable.model_fields) - {"setup"}) | {"setup_id": self.setup}


class DiagonalTable(BeamTable):
    """One ``[[test]]`` of kind diagonal; without ``order`` the diagonal is run straight."""

    kind: Literal["diagonal"]
    diagonal: Literal["ppp", "npp", "pnp", "ppn"]
    order: Order | None = None
    steps: Steps = 12

    @model_validator(mode="after")
    def _no_overrun(self) -> DiagonalTable:
        if self.order and self.overrun_mm:
            raise ValueError("expected no overrun_mm beside order: a step diagonal turns where it stands")
        return self

    def recipe(self) -> Diagonal:
        """The recipe, mounting and clearing away by itself."""
        return Diagonal(**self.common(), diagonal=self.diagonal, steps=self.steps, order=self.order or "")


class FaceTable(BeamTable):
    """One ``[[test]]`` of kind face; ``at_share``: place of the axis that stands, in its stroke."""

    kind: Literal["face"]
    plane: Literal["XY", "YZ", "ZX"]
    diagonal: Literal["pp", "np"]
    at_share: Share = 0.5
    steps: Steps = 12

    def recipe(self) -> FaceDiagonal:
        """The recipe, mounting and clearing away by itself."""
        return FaceDiagonal(**self.common(), plane=self.plane, diagonal=self.diagonal, steps=self.steps, at=self.at_share)


class LineTable(BeamTable):
    """One ``[[test]]`` of kind line; ``at_share``: places of the two other axes in their strokes, 0 to 1, in the order X, Y, Z."""

    kind: Literal["line"]
    axis: Letter
    at_share: tuple[Share, Share]
    positions: Annotated[int, Field(ge=5, le=1000)] = 25
    offset_share: Annotated[float, Field(ge=0.0, le=0.4)] = 0.0
    seed: Annotated[int, Field(ge=0, le=2**31)] = 1

    def recipe(self) -> Linear:
        """The recipe, mounting and clearing away by itself."""
        own: dict[str, Any] = {"n": self.positions, "at": self.at_share, "offset_share": self.offset_share, "seed": self.seed}
        return Linear(**self.common(), axis=AXES.index(self.axis), **own)


KINDS: dict[str, type[TestTable]] = {"diagonal": DiagonalTable, "face": FaceTable, "line": LineTable}


def laser_table(recipe: LaserRecipe) -> dict[str, Any]:
    """The keys of a laser recipe as they stand in a file."""
    rest: dict[str, Any] = {"feed_mm_min": recipe.feed_mm_min, "settle_s": recipe.settle_s}
    rest |= {"cycles": recipe.cycles} if recipe.cycles > 1 else {}
    rest |= {"overrun_mm": recipe.overrun_mm} if recipe.overrun_mm else {}
    if isinstance(recipe, Diagonal):
        order = {"order": recipe.order} if recipe.order else {}
        return {"kind": "diagonal", "diagonal": recipe.diagonal, **order, "steps": recipe.steps, **rest}
    if isinstance(recipe, FaceDiagonal):
        own = {"plane": recipe.plane, "diagonal": recipe.diagonal, "at_share": recipe.at, "steps": recipe.steps}
        return {"kind": "face", **own, **rest}
    at = [recipe.at] * 2 if isinstance(recipe.at, float) else list(recipe.at)
    offset = {"offset_share": recipe.offset_share, "seed": recipe.seed} if recipe.offset_share else {}
    return {"kind": "line", "axis": AXES[recipe.axis], "at_share": at, "positions": recipe.n, **offset, **rest}
