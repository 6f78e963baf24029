"""Cures for hidden combinations: measurements or certificates that would show them.

Every usual addition is tried: the rank with the addition is computed for this campaign, so the advice fits this machine and these runs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import Term
from abbe.models.machine import AXES, Machine, with_tool
from abbe.models.paths import DIAGONALS, diagonal_ends, helix_points, step_diagonal, straight_line
from abbe.models.solvers.least_squares import project_out, singular_values
from abbe.models.solvers.observability.rank import (
    CampaignColumns,
    Knowledge,
    ObservedInformation,
    Play,
    campaign_columns,
    play,
    stated_knowledge,
    with_knowledge,
)
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import SAME_PLACE_MM, SetupUnknowns, setup_unknowns, straight_line_of
from abbe.models.solvers.priors import Priors

ALONG = 1e-3
"""Components of a direction above this count: a line along an axis has one, a body diagonal has three."""
STEP_ORDERS = ("XYZ", "ZYX", *("".join(p) for p in permutations("XYZ") if p not in (("X", "Y", "Z"), ("Z", "Y", "X"))))
LONGER_MM = 100.0
ASIDE_MM = (100.0, 50.0)
"""Virtual tools for a trial: additional length (`LONGER_MM`), and two offsets from the tool's line."""
READINGS, RUNS = 130, 10
"""Most readings of a virtual run, and most runs repeated with another tool; a rank needs few."""
SHORTEST_BAR_MM = 10.0
"""Length of the shortest ball-bar."""
MARGIN = 0.1
"""Fraction of the stroke between virtual runs and its ends."""
SHOWN = 1e-7
"""A hidden combination counts as shown if its effect on an addition's readings (unit columns) is at least this; hidden means below 1e-9."""


@dataclass(frozen=True)
class Present:
    """Runs of a campaign by kind.

    Attributes
    ----------
    lines : midpoints (mm) of the laser lines along each axis.
    stepped : step diagonals as (signs of the body diagonal, order of the steps).
    plain : int
        Number of diagonals that were run straight.
    cups : int
        Number of different ball-bar centres.
    """

    lines: tuple[tuple[F1, ...], tuple[F1, ...], tuple[F1, ...]]
    stepped: tuple[tuple[str, str], ...]
    plain: int
    cups: int

    @property
    def orders(self) -> tuple[str, ...]:
        """Orders in which diagonals were stepped."""
        return tuple(dict.fromkeys(order for _, order in self.stepped))

    @property
    def next_order(self) -> str:
        """The first step order that no diagonal has; the last one if all are used."""
        return next((o for o in STEP_ORDERS if o not in self.orders), STEP_ORDERS[-1])

    @property
    def diagonals(self) -> int:
        """Number of the four body diagonals that were stepped."""
        return len({name for name, _ in self.stepped})


def present(runs: tuple[RunData, ...]) -> Present:
    """Sort the runs of a campaign by kind."""
    lines: tuple[list[F1], list[F1], list[F1]] = ([], [], [])
    stepped, plain, cups = [], 0, set()
    for run in runs:
        if run.centre_mm is not None:
            cups.add(tuple(np.round(run.centre_mm / SAME_PLACE_MM)))
            continue
        line = straight_line_of(run.axes_mm)
        if line is None:
            stepped += _stepped(run)
        elif (np.abs(line[1]) > ALONG).sum() == 1:
            lines[int(np.argmax(np.abs(line[1])))].append(line[0])
        elif (np.abs(line[1]) > ALONG).all():
            plain += 1
    return Present((tuple(lines[0]), tuple(lines[1]), tuple(lines[2])), tuple(stepped), plain, len(cups))


def _stepped(run: RunData) -> list[tuple[str, str]]:
    """Body diagonal (either direction) and step order of a run in single-axis steps; empty if an axis never steps alone."""
    steps = np.diff(run.axes_mm, axis=0)
    big = np.abs(steps) > ALONG * np.abs(steps).max()
    moves = [(int(np.argmax(b)), float(s[np.argmax(b)])) for b, s in zip(big, steps, strict=True) if b.sum() == 1]
    first = list(dict.fromkeys(axis for axis, _ in moves))
    if len(first) < len(AXES):
        return []
    signs = [np.sign(next(s for axis, s in moves if axis == a)) for a in range(3)]
    return [("".join("p" if s == signs[0] else "n" for s in signs), "".join(AXES[a] for a in first))]


def place_text(axis: int, place_mm: F1) -> str:
    """Text for the position of a line along an axis: "Y = 40 mm, Z = 30 mm"."""
    return ", ".join(f"{AXES[k]} = {place_mm[k]:.0f} mm" for k in range(3) if k != axis)


def free_corner(machine: Machine, axis: int, inner: np.ndarray[tuple[int, ...], np.dtype[np.float64]], places: tuple[F1, ...]) -> F1:
    """The edge of the inner volume (3, 2) along an axis that is farthest from the lines at ``places``; without lines the lowest edge.

    The result is the edge's lower end, mm.
    """
    others = [k for k in range(3) if k != axis]
    corners = []
    for sides in product((0, 1), repeat=2):
        corner = inner[:, 0].copy()
        corner[others] = inner[others, sides]
        corners.append(corner)
    if not places:
        return corners[0]
    size = machine.length_mm[others]
    away = [min(float(np.linalg.norm((c - p)[others] / size)) for p in places) for c in corners]
    return corners[int(np.argmax(away))]


def on_opposite_edges(machine: Machine, axis: int, places: tuple[F1, ...]) -> bool:
    """Whether two lines along an axis are at least half the stroke apart in both other axes."""
    others = [k for k in range(3) if k != axis]
    return any((np.abs(a - b)[others] >= 0.5 * machine.length_mm[others]).all() for a in places for b in places)


@dataclass(frozen=True)
class Addition:
    """One possible addition to a campaign: the cause that it removes, the cure as text, and its virtual runs.

    ``knows``: set-up unknowns that a certificate makes known; ``ending``: text after "cannot be distinguished" in the report, e.g. " with
    one tool length".
    """

    key: str
    cause: str
    cure: str
    runs: tuple[RunData, ...] = ()
    knows: tuple[str, ...] = ()
    ending: str = ""


def additions(machine: Machine, runs: tuple[RunData, ...], known: Knowledge, names: tuple[str, ...], order: int) -> tuple[Addition, ...]:
    """Return possible additions to these runs, cheapest first. Each cause is a fact about the runs, e.g. "no ball-bar was used".

    Parameters
    ----------
    known, names : Knowledge, tuple of str
        What is known of the set-up; names of all its unknowns.
    order : int
        Highest order of the error motions: lines and diagonals get enough positions for it.
    """
    there = present(runs)
    lasers = (*_lines(machine, there, order), _edges(machine, there, order), _diagonals(machine, there, order))
    if not all(r.mirror_turns for r in runs if r.kind == "laser"):  # another laser run would have the same mirror
        lasers = tuple(replace(a, runs=tuple(replace(r, mirror_turns=False) for r in a.runs)) for a in lasers)
    return (*_certificates(known, names), *lasers, *_bar_additions(machine, runs, there))


def _certificates(known: Knowledge, names: tuple[str, ...]) -> list[Addition]:
    """Additions that need no measurement on the machine."""
    out = []
    if lengths := tuple(n for n in names if n.startswith("bar_length_") and n not in known.fixed):
        some = any(n.startswith("bar_length_") for n in known.fixed)
        radii = " and ".join(n.removeprefix("bar_length_") for n in lengths)
        cause = f"the length of the bar of {radii} mm is not calibrated" if some else "no bar length here is calibrated"
        out.append(Addition("bar", cause, "a calibrated bar", knows=lengths))
    if tilts := tuple(n for n in names if n.startswith("tilt_") and n not in known.fixed):
        out.append(
            Addition(
                "tilt", "an unknown tilt of the mirror gives the same readings as these errors", "a mirror of measured tilt", knows=tilts
            )
        )
    return out


def _lines(machine: Machine, there: Present, order: int) -> list[Addition]:
    """One laser line along each axis, far from those that the campaign has."""
    out = []
    for k, a in enumerate(AXES):
        places = there.lines[k]
        corner = free_corner(machine, k, _inner(machine), places)
        if not places:
            cause, cure = f"nothing here measures {a} alone against a known length", f"a laser line along {a}"
        else:
            examples = "; ".join(place_text(k, p) for p in places[:2]) + ("; ..." if len(places) > 2 else "")
            count = "one line" if len(places) == 1 else f"{len(places)} lines"
            cause = f"{a} alone was measured along {count} only ({examples})"
            cure = f"another laser line along {a} at {place_text(k, corner)}"
        out.append(Addition(f"line {a}", cause, cure, (_line(machine, k, corner, order),)))
    return out


def _edges(machine: Machine, there: Present, order: int) -> Addition:
    """Lines along all axes on two opposite edges; if the campaign has these, on two other edges."""
    inner, cure = _inner(machine), "laser lines along X, Y and Z on two opposite edges"
    sides = np.array([[0, 0, 0], [1, 1, 1]])
    if not any(there.lines):
        cause = "there are no laser lines here"
    elif all(on_opposite_edges(machine, k, there.lines[k]) for k in range(3)):
        cause, cure = "the laser lines here stand on too few edges", "laser lines along X, Y and Z on two more edges"
        sides = np.array([[0, 0, 1], [0, 1, 0]])  # rolled by the axis: low in one of the other two axes, high in the other
    else:
        cause = "the laser lines here do not stand on opposite edges in all three axes"
    runs = tuple(_line(machine, k, inner[range(3), np.roll(side, k)], order, i) for k in range(3) for i, side in enumerate(sides))
    return Addition("edges", cause, cure, runs)


def _diagonals(machine: Machine, there: Present, order: int) -> Addition:
    """Step diagonals in a step order that the campaign does not have."""
    sequence, done = there.next_order, " and ".join(there.orders)
    if there.stepped and there.diagonals < len(DIAGONALS):
        cause = f"only {there.diagonals} of the four body diagonals {'was' if there.diagonals == 1 else 'were'} stepped ({done})"
        cure = f"step diagonals along all four body diagonals in another step order ({sequence})"
    elif len(there.orders) == 1:
        cause, cure = f"all step diagonals were stepped in one order ({done})", f"step diagonals in a second step order ({sequence})"
    elif there.stepped:
        cause, cure = f"the diagonals were stepped in {done} only", f"step diagonals in another step order ({sequence})"
    else:
        cause = "the diagonals here were run straight, without steps" if there.plain else "nothing here crosses the volume step by step"
        cure = "four step diagonals"
    return Addition("diagonals", cause, cure, tuple(_diagonal(machine, d, sequence, order) for d in DIAGONALS))


def _bar_additions(machine: Machine, runs: tuple[RunData, ...], there: Present) -> list[Addition]:
    longer, aside = _other_tools(machine, runs)
    one = len({tuple(np.round(with_tool(machine, r.tool_mm).tool_mm, 6)) for r in runs}) == 1
    length = "all runs used one tool length" if one else "no tool of these runs has a lever arm that separates these errors"
    beside = "in all runs the tool's end lay on one line, and a rotation about this line changes no reading" if one else length
    short = " with one tool length" if one else " with these tools"
    lined = " with tools that end on one line" if one else short
    count = "at one place" if there.cups == 1 else f"at {there.cups} places"
    cups = f"the ball-bar stood {count} only" if there.cups else "no ball-bar was used"
    helices = _helices(machine, runs)
    return [
        *([Addition("centres", cups, "ball-bar helices about five centres", helices)] if helices else []),
        Addition("tool", length, "a second tool length" if one else "another tool length", _with(runs, longer, "long"), (), short),
        Addition("aside", beside, "a tool whose end stands off to the side", _with(runs, aside, "aside"), (), lined),
    ]


def _laser(label: str, path_mm: F2) -> RunData:
    n, way = len(path_mm), path_mm[-1] - path_mm[0]
    beam = way / np.linalg.norm(way)
    return RunData(label, label, "laser", path_mm, np.zeros(n), np.zeros((n, 3)), np.zeros(n), np.ones(n), beam=beam)


def _line(machine: Machine, axis: int, through_mm: F1, order: int, number: int = 0) -> RunData:
    """A virtual laser line along an axis through a point, `MARGIN` inside the stroke."""
    start, end = through_mm.copy(), through_mm.copy()
    start[axis], end[axis] = _inner(machine)[axis]
    return _laser(f"virtual {AXES[axis]}{number}", straight_line(start, end, 2 * order + 3, back=False))


def _diagonal(machine: Machine, name: str, sequence: str, order: int) -> RunData:
    start, end = diagonal_ends(_inner(machine), name)
    return _laser(f"virtual {name} {sequence}", step_diagonal(start, end, 2 * order + 4, sequence, back=False))


def _inner(machine: Machine) -> F2:
    return np.asarray(machine.stroke_mm + MARGIN * machine.length_mm[:, None] * np.array([1.0, -1.0]))


def _helices(machine: Machine, runs: tuple[RunData, ...]) -> tuple[RunData, ...]:
    """Virtual helices about the middle and four centres around it, with the campaign's bar if it has one; none if no bar fits."""
    own = next((r for r in runs if r.radius_mm is not None), None)
    radius = 0.2 * float(machine.length_mm.min()) if own is None or own.radius_mm is None else own.radius_mm
    if own is None and radius < SHORTEST_BAR_MM:
        return ()
    pole = int(np.argmax(np.abs(machine.tool_mm))) if machine.tool_mm.any() else 2
    across = [a for a in range(3) if a != pole]
    aside = np.clip(0.25 * machine.length_mm, 0.0, np.maximum(0.5 * machine.length_mm - radius, 0.0))  # beyond the stroke nothing is stated
    out = []
    for k, signs in enumerate(((0, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))):
        centre = machine.centre_mm.copy()
        centre[across] += aside[across] * signs
        centre[pole] -= 0.5 * radius
        path = helix_points(centre, radius, turns=5, n=READINGS, law="area", axis=pole)
        n, name = len(path), f"virtual helix {k}"
        bar = RunData(name, name, "bar", path, np.zeros(n), np.zeros((n, 3)), np.zeros(n), np.ones(n), centre, radius)
        out.append(bar if own is None else replace(bar, u_length_mm=own.u_length_mm, length_calibrated=own.length_calibrated))
    return tuple(out)


def _other_tools(machine: Machine, runs: tuple[RunData, ...]) -> tuple[F1, F1]:
    """A tool longer than those of the runs, and a tool whose end has a lateral offset, vectors in mm."""
    tools = [with_tool(machine, r.tool_mm).tool_mm for r in runs]
    tool = max(tools, key=lambda t: float(np.linalg.norm(t)))
    along = tool / np.linalg.norm(tool) if tool.any() else np.array([0.0, 0.0, -1.0])
    helper = np.eye(3)[int(np.argmin(np.abs(along)))]
    first = np.cross(along, helper) / np.linalg.norm(np.cross(along, helper))
    return tool + LONGER_MM * along, tool + ASIDE_MM[0] * first + ASIDE_MM[1] * np.cross(along, first)


def _with(runs: tuple[RunData, ...], tool_mm: F1, key: str) -> tuple[RunData, ...]:
    """The ball-bar runs (the laser runs if there are none) repeated with another tool and new set-ups."""
    out = []
    others = tuple(r for r in runs if r.points is None or r.points.source != "length")
    for run in (tuple(r for r in runs if r.kind == "bar") or others)[:RUNS]:
        n = run.deviation_mm.size
        at = np.unique(np.linspace(0, n - 1, n if run.points else min(n, READINGS)).round().astype(np.intp))
        parts = {name: getattr(run, name)[at] for name in ("axes_mm", "deviation_mm", "sign", "t_s", "weight_n")}
        out.append(replace(run, label=f"{key} {run.label}", setup=f"{key} {run.setup}", tool_mm=tool_mm, **parts))
    return tuple(out)


@dataclass(frozen=True)
class CampaignLayout:
    """A measured or planned campaign: nominal machine, model terms, runs, their compressed columns, and knowledge of the set-up."""

    machine: Machine
    terms: tuple[Term, ...]
    runs: tuple[RunData, ...]
    columns: CampaignColumns
    known: Knowledge


@dataclass(frozen=True)
class CureTrial:
    """An addition and its readings per unit of each hidden combination, set-up unknowns projected out: ``observed``, shape (rows, k)."""

    addition: Addition
    observed: F2

    def shows(self, combinations: F2) -> int:
        """Number of combinations that the addition shows, of hidden ones given as columns (k, m) of orthonormal coordinates."""
        return count_observed(self.observed @ combinations)


def count_observed(observed: F2) -> int:
    """Number of hidden combinations that a design, shape (rows, k), shows (`SHOWN`)."""
    s = singular_values(observed) if observed.size else np.zeros(0)
    return int((s > SHOWN).sum())


def trials(campaign: CampaignLayout, observed: ObservedInformation) -> list[CureTrial]:
    """Try every usual addition, and return what each shows of the hidden combinations; an empty list if nothing is hidden."""
    if not observed.null_space.shape[1]:
        return []
    order = max(t.order for t in campaign.terms)
    tried = additions(campaign.machine, campaign.runs, campaign.known, campaign.columns.setup_names, order)
    hidden = play(campaign.columns, campaign.known, observed)
    return [CureTrial(a, _shown(campaign, a, hidden)) for a in tried]


def best_sequence(found: list[CureTrial], hidden: int) -> list[tuple[Addition, int]]:
    """Choose one by one the addition that shows most combinations still hidden; return the additions with the number shown after each."""
    out: list[tuple[Addition, int]] = []
    stack, left, shown = np.zeros((0, hidden)), list(found), 0
    while left and shown < hidden:
        counts = [count_observed(np.concatenate([stack, t.observed])) for t in left]
        best = int(np.argmax(counts))
        if counts[best] <= shown:
            break
        shown = counts[best]
        stack = np.concatenate([stack, left[best].observed])
        out.append((left.pop(best).addition, shown))
    return out


def _shown(campaign: CampaignLayout, addition: Addition, hidden: Play) -> F2:
    """Readings of an addition per unit of each hidden combination, its set-up unknowns projected out, compressed to (at most k, k)."""
    if not addition.runs:
        at = [i for i, group in enumerate(hidden.groups) if set(group) & set(addition.knows)]
        size = np.linalg.norm(campaign.columns.setup[:, [campaign.columns.setup_names.index(hidden.groups[i][0]) for i in at]], axis=0)
        return _upper(project_out(hidden.free[at] * size[:, None], hidden.loose[at] * size[:, None]))
    runs = (*campaign.runs, *addition.runs)
    setup = setup_unknowns(runs, Priors(), campaign.machine)
    new = campaign_columns(campaign.machine, campaign.terms, addition.runs, setup)
    known = _known_with(campaign, runs, setup, new)
    machine, free, groups = with_knowledge(new, known)
    old = [next((k for k, g in enumerate(hidden.groups) if set(g) & set(group)), -1) for group in groups]
    shared, fresh = [i for i, k in enumerate(old) if k >= 0], [i for i, k in enumerate(old) if k < 0]
    there = [old[i] for i in shared]
    response = machine @ hidden.machine + free[:, shared] @ hidden.free[there]
    size = np.linalg.norm(free[:, shared], axis=0) @ np.abs(hidden.loose[there])
    loose = free[:, shared] @ hidden.loose[there]
    loose = loose[:, np.linalg.norm(loose, axis=0) > SHOWN * size]
    return _upper(project_out(response, np.concatenate([loose, free[:, fresh]], axis=1)))


def _known_with(campaign: CampaignLayout, runs: tuple[RunData, ...], setup: SetupUnknowns, new: CampaignColumns) -> Knowledge:
    """Return the campaign's knowledge, extended to the addition's set-up unknowns by the rules of `stated_knowledge`."""
    known, before = campaign.known, set(campaign.columns.setup_names)
    stated = stated_knowledge(campaign.terms, runs, setup.names).fixed
    fixed = {n: v for n, v in stated.items() if n not in before} | {n: v for n, v in known.fixed.items() if n in new.setup_names}
    return replace(known, fixed=fixed)


def _upper(shown: F2) -> F2:
    return np.asarray(scipy.linalg.qr(shown, mode="r", check_finite=False)[0][: shown.shape[1]])
