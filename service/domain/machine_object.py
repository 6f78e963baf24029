"""The ``machine`` object of the exchange format, and its types, which the machine file shares."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field


def check_chain(text: str) -> str:
    """Return a valid kinematic chain, e.g. ``"w-X-Y-b-Z-t"``.

    Raises
    ------
    ValueError
        The chain does not go from w to t over b with each of X, Y, Z once.
    """
    parts = text.split("-")
    if parts[0] != "w" or parts[-1] != "t" or sorted(parts[1:-1]) != ["X", "Y", "Z", "b"]:
        raise ValueError(f"expected a chain from w to t with X, Y, Z and b once each, e.g. 'w-X-Y-b-Z-t', got {text!r}")
    return text


def _check_interval(pair: tuple[float, float]) -> tuple[float, float]:
    if not pair[0] < pair[1]:
        raise ValueError(f"expected [smaller, larger], got {list(pair)}")
    return pair


Chain = Annotated[str, AfterValidator(check_chain)]
Interval = Annotated[tuple[float, float], AfterValidator(_check_interval)]
Point = tuple[float, float, float]


class FileObject(BaseModel):
    """Base of everything in an exchange file: unknown keys are kept, numbers are finite, text is not a number."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False, strict=True, frozen=True)

    @classmethod
    def read(cls, doc: object) -> Self:
        """Validate a parsed JSON object, in which lists stand for tuples.

        Raises
        ------
        pydantic.ValidationError
            The object has another form.
        """
        return cls.model_validate(doc, strict=False)


class Strokes(FileObject):
    """Travel of each axis, commanded coordinates, mm."""

    X: Interval
    Y: Interval
    Z: Interval


class Pivots(FileObject):
    """Points about which carriages turn, mm."""

    X: Point | None = None
    Y: Point | None = None
    Z: Point | None = None


class MachineObject(FileObject):
    """Nominal geometry of a machine."""

    name: str | None = None
    chain: Chain = Field(description="carriages from workpiece w over bed b to tool t")
    vertical_axis: Literal["X", "Y", "Z"]
    stroke_mm: Strokes
    pivots_mm: Pivots | None = None
    tool_mm: Point | None = None
