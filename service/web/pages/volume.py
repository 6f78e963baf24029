"""The volume map for the screen: nodes with their uncertainty, a slice as a picture, and the motions without a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode

import numpy as np
from markupsafe import Markup

from abbe.models.uncertainty.what_if import expected_rms
from abbe.service.domain.results import SolutionRecord
from abbe.service.errors import AbbeError
from abbe.service.identification.solution_field import NodeMap, StoredField, node_map, stored_field
from abbe.service.rendering.numbers import placed, tidy
from abbe.service.rendering.plots.slices import PLANES, SlicePlane, SliceTexts, colour_top, magnification, slice_plot, steps
from abbe.service.storage.store import Store
from abbe.service.web.frame import current
from abbe.service.web.language import Translate

NODES = (3, 4, 5, 6)
"""Nodes per axis. More would make the table too large for a screen; the HTTP interface gives finer grids."""
STILL, STILL_UM = "0", 1e-9
"""Text of a component that the chosen motions do not affect; largest uncertainty, µm, of such a component (rounding)."""
NOTHING = Markup("")


@dataclass(frozen=True, slots=True)
class VolumeQuery:
    """The requested view. ``at``: index of the slice, from 0; -1 for the middle one. ``motions``: the chosen ones; empty for all."""

    motions: tuple[str, ...] = ()
    plane: str = "XY"
    at: int = -1
    nodes: int = 6


@dataclass(frozen=True, slots=True)
class NodeLine:
    """A node in the reader's units: position; dX, dY, dZ and length with U (k = 2); ``significant``: its 95 % ellipsoid excludes 0."""

    place: tuple[str, str, str]
    parts: tuple[tuple[str, str], ...]
    significant: bool


@dataclass(frozen=True, slots=True)
class VolumeScreen:
    """The map in the reader's units.

    ``lines``: all nodes; ``source``: address of the numbers for the script, in mm and µm; ``top``: upper end of the colour scale;
    ``not_significant``: number of nodes whose error may be zero; ``trouble``: why there is no map.
    """

    number: int
    campaign: str
    query: VolumeQuery
    motions: Sequence[tuple[str, str, bool, bool]] = ()
    hidden: Sequence[tuple[str, str]] = ()
    lines: Sequence[NodeLine] = ()
    levels: Sequence[str] = ()
    source: str = ""
    picture: Markup = NOTHING
    figures: Sequence[tuple[str, str]] = ()
    not_significant: int = 0
    steps: Sequence[str] = ()
    top: float = 1.0
    magnified: float = 1.0
    trouble: str = ""

    @property
    def axes(self) -> list[tuple[str, list[tuple[str, str, bool, bool]]]]:
        """Motions grouped by axis; squareness belongs to none and comes last."""
        groups = [(axis, [m for m in self.motions if m[0][1] != "0" and m[0][2] == axis]) for axis in "XYZ"]
        return [*groups, ("", [m for m in self.motions if m[0][1] == "0"])]


def volume_screen(store: Store, record: SolutionRecord, query: VolumeQuery, translate: Translate) -> VolumeScreen:
    """The map of a stored solution; ``trouble`` if there is none."""
    campaign = store.campaigns.find(record.campaign_id).name
    try:
        stored = stored_field(store, record)
    except (AbbeError, ValueError, KeyError, TypeError) as error:
        return VolumeScreen(record.id, campaign, query, trouble=error.detail if isinstance(error, AbbeError) else repr(error))
    # Motions without a map of their own, e.g. from a link to another solution, are left out; the screen names them.
    chosen = tuple(name for name in stored.motions if name in query.motions and name not in stored.hidden)
    query = VolumeQuery(chosen, query.plane, query.at, query.nodes)
    found = node_map(stored, query.nodes, chosen)
    return _screen(stored, campaign, query, found, translate)


def _screen(stored: StoredField, campaign: str, query: VolumeQuery, found: NodeMap, translate: Translate) -> VolumeScreen:
    n, third = query.nodes, PLANES[query.plane][2]
    at = query.at if 0 <= query.at < n else n // 2
    levels = np.unique(found.points_mm[:, third])
    place, error = current().drawn("mm"), current().drawn()
    length, top = found.length_um, colour_top(found.length_um / error.size)
    magnified = magnification(float(stored.known.machine.length_mm.max()), float(length.max()))
    level = placed(float(levels[at]), place)
    texts = SliceTexts(
        translate("volume.slice", plane=query.plane, axis="XYZ"[third], at=level, unit=place.sign),
        translate("volume.nominal"), translate("volume.actual"), translate("volume.not_known"),
        translate("volume.magnified", n=tidy(magnified)), place, error,
    )  # fmt: skip
    cut = _slice(found, query.plane, at)
    part = stored.known.part(query.motions) if query.motions else stored.known
    rms_mm, u_mm = expected_rms(part, n)
    figures = _figures(found, rms_mm * 1e3, u_mm * 1e3, translate)
    parameters = [("nodes", query.nodes), *(("motion", name) for name in query.motions)]
    motions = [(m, stored.statuses.get(m, ""), m in stored.hidden, not query.motions or m in query.motions) for m in stored.motions]
    # The SVG writer has already escaped every text.
    picture = Markup(slice_plot(cut, top, magnified, texts))  # noqa: S704
    return VolumeScreen(
        stored.number, campaign, VolumeQuery(query.motions, query.plane, at, n), motions, list(stored.hidden.items()), node_lines(found),
        [placed(float(v), place) for v in levels], f"/api/v1/solutions/{stored.number}/field?{urlencode(parameters)}", picture, figures,
        int((~found.significant).sum()), steps(top), top, magnified,
    )  # fmt: skip


def _figures(found: NodeMap, rms_um: float, u_um: float, translate: Translate) -> list[tuple[str, str]]:
    """Largest error, its position, and rms."""
    frame = current()
    worst = int(np.argmax(found.length_um))
    largest = frame.with_u(float(found.length_um[worst]), float(found.u_um[worst, 3]))
    position = ", ".join(placed(float(v), frame.drawn("mm")) for v in found.points_mm[worst])
    return [
        (translate("volume.largest"), "{} ± {} {}".format(*largest, frame.unit())),
        (translate("volume.where"), f"({position}) {frame.unit('mm')}"),
        (translate("volume.rms_map"), "{} ± {} {}".format(*frame.with_u(rms_um, u_um), frame.unit())),
    ]


def _slice(found: NodeMap, plane: str, at: int) -> SlicePlane:
    n, (across, up, third) = found.nodes, PLANES[plane]

    def cut(values: Any) -> Any:
        grid = values.reshape(n, n, n, *values.shape[1:]).take(at, axis=third)
        return grid if across < up else np.swapaxes(grid, 0, 1)

    return SlicePlane(plane, cut(found.points_mm), cut(found.deviation_um), cut(2.0 * found.u_um[:, 3]), cut(found.significant))


def node_lines(found: NodeMap) -> list[NodeLine]:
    """All nodes in the reader's units."""
    frame = current()
    values = np.column_stack([found.deviation_um, found.length_um])
    out = []
    for place, row, u, significant in zip(found.points_mm, values, found.u_um, found.significant, strict=True):
        x, y, z = (placed(float(v), frame.drawn("mm")) for v in place)
        parts = tuple(frame.with_u(float(v), float(s)) if s > STILL_UM else (STILL, STILL) for v, s in zip(row, u, strict=True))
        out.append(NodeLine((x, y, z), parts, bool(significant)))
    return out
