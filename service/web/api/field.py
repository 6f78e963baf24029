"""Route: the map of the volume of a solution."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import FastAPI, Query
from pydantic import Field

from abbe.service.identification.solution_field import NodeMap, StoredField, node_map, stored_field
from abbe.service.users.roles import Permission
from abbe.service.web.api.shapes import Answer
from abbe.service.web.api.sources import Number, Sources, as_stored
from abbe.service.web.login.access import needs

MOST_NODES = 9
Nodes = Annotated[int, Query(ge=2, le=MOST_NODES, description="So many per axis.")]
Motion = Literal[
    "EXX", "EYX", "EZX", "EAX", "EBX", "ECX", "EXY", "EYY", "EZY", "EAY", "EBY", "ECY",
    "EXZ", "EYZ", "EZZ", "EAZ", "EBZ", "ECZ", "C0Y", "B0Z", "A0Z",
]  # fmt: skip
Motions = Annotated[list[Motion], Query(max_length=21, description="Only what these make together; none: all of them.")]


class HiddenMotion(Answer):
    """A motion that the runs do not show by itself, and why."""

    motion: str
    reason: str


class VolumeMap(Answer):
    """Deviation (actual minus nominal, best-fit rigid motion removed) at the nodes of an even grid over the strokes, X slowest.

    Nodes lie at every crossing of ``x_mm``, ``y_mm``, ``z_mm``. ``deviation_um``: dX, dY, dZ; ``expanded_um``: their U and that of the
    length, k = 2. ``told``: whether the 95 % ellipsoid about the deviation leaves out zero; where it does not, neither error nor
    direction is known. ``hidden``: what is in no map of single motions.
    """

    solution: int
    motions: list[str] = Field(description="What the map is made of.")
    nodes: int
    x_mm: list[float]
    y_mm: list[float]
    z_mm: list[float]
    deviation_um: list[tuple[float, float, float]]
    expanded_um: list[tuple[float, float, float, float]]
    told: list[bool]
    coverage_factor: float = 2.0
    hidden: list[HiddenMotion]


def add_field(app: FastAPI, sources: Sources) -> None:
    """Add the route."""

    @app.get("/api/v1/solutions/{number}/field")
    @needs(Permission.READ)
    def field(number: Number, motion: Motions = [], nodes: Nodes = 6) -> VolumeMap:  # noqa: B006 - FastAPI copies it
        """The map of the volume: deviation and uncertainty at the nodes, from the solution's whole covariance."""
        sources.row("solutions", number, "solution")
        with as_stored():
            stored = stored_field(sources.store, sources.store.solution(number))
            return volume_map(stored, node_map(stored, nodes, motion), motion)


def volume_map(stored: StoredField, found: NodeMap, motions: list[Motion]) -> VolumeMap:
    """A map as an answer; a thousandth of a micrometre is far below every U."""
    n = found.nodes
    grid = found.points_mm.reshape(n, n, n, 3)
    x, y, z = ([round(float(v), 3) for v in axis] for axis in (grid[:, 0, 0, 0], grid[0, :, 0, 1], grid[0, 0, :, 2]))
    return VolumeMap(
        solution=stored.number,
        motions=[name for name in stored.motions if not motions or name in motions],
        nodes=n,
        x_mm=x,
        y_mm=y,
        z_mm=z,
        deviation_um=found.deviation_um.round(3).tolist(),
        expanded_um=(2.0 * found.u_um).round(3).tolist(),
        told=found.told.tolist(),
        hidden=[HiddenMotion(motion=name, reason=why) for name, why in stored.hidden.items()],
    )
