"""What every ``[[test]]`` of a recipe file is made of: names, numbers with their limits, and the keys that all tests have."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Name = Annotated[str, Field(min_length=1, max_length=80, pattern=r"^[^\s/\\](?:[^\n\r/\\]*[^\s/\\])?$")]
Feed = Annotated[float, Field(gt=0.0, le=100_000.0)]
Coordinate = Annotated[float, Field(ge=-1e5, le=1e5)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Settle = Annotated[float, Field(ge=0.0, le=60.0)]
Letter = Literal["X", "Y", "Z"]
Role = Literal["identify", "holdout"]


class RecipeTable(BaseModel):
    """Frozen, and without keys that nobody knows."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class TestTable(RecipeTable):
    """Keys of every test."""

    __test__ = False  # not a pytest class

    label: Name
    setup: Name
    role: Role = "identify"
