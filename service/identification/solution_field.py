"""A stored solution as a map of the machine's volume: the motions that can be shown separately, and deviation with U at every node."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.geometry.volume import volume_grid
from abbe.models.uncertainty.coverage import apart_from_zero
from abbe.models.uncertainty.known_field import KnownField, field_map
from abbe.service.domain.machine import machine_from_doc
from abbe.service.domain.results import SolutionRecord
from abbe.service.domain.solution_file import stored_solution
from abbe.service.errors import NotObservable, Unusable
from abbe.service.storage.store import Store
from abbe.service.verification.deviations import standard_uncertainty_mm

HIDDEN = "not observable"
UM = 1e3


@dataclass(frozen=True)
class StoredField:
    """The deviation field of a solution. ``hidden``: motions that its runs do not show separately, and why."""

    number: int
    known: KnownField
    hidden: Mapping[str, str]
    statuses: Mapping[str, str]
    means: Mapping[str, tuple[float, float]]
    """Scales (EXX, mm/mm) and squareness (C0Y, rad), means over the volume with standard uncertainty; known even if motions are not."""

    @property
    def motions(self) -> list[str]:
        """All motions in the model's order."""
        return list(dict.fromkeys(t.motion for t in self.known.terms))

    def observable_motions(self, motions: Iterable[str]) -> list[str]:
        """Return the chosen motions in the model's order, each checked to be observable separately.

        Raises
        ------
        NotObservable
            The runs do not show one of the motions separately.
        Unusable
            The solution lacks one of the motions.
        """
        wanted = list(dict.fromkeys(motions))
        unknown = [name for name in wanted if name not in self.motions]
        if unknown:
            raise Unusable(f"solution {self.number} has no motion {', '.join(unknown)}", "ask for motions of its model")
        lost = [name for name in wanted if name in self.hidden]
        if lost:
            raise NotObservable(
                f"solution {self.number} cannot separate {', '.join(lost)} from other motions ({self.hidden[lost[0]]})",
                "leave it out, or ask for all motions together",
            )
        return [name for name in self.motions if name in wanted]


@dataclass(frozen=True, eq=False)
class NodeMap:
    """Deviation at the nodes of an even grid, best-fit rigid motion removed, µm.

    ``u_um``: standard uncertainty of dX, dY, dZ and of the length, shape (n, 4). ``significant``: whether the 95 % ellipsoid of the
    deviation excludes zero; elsewhere neither the existence nor the direction of an error is established. A length above its own U (k = 2)
    is no such criterion: a length is never negative, and noise in three components alone often exceeds U.
    """

    nodes: int
    points_mm: F2
    deviation_um: F2
    u_um: F2
    significant: NDArray[np.bool_]

    @property
    def length_um(self) -> F1:
        """Length of the deviation, shape (n,)."""
        return np.asarray(np.linalg.norm(self.deviation_um, axis=1))


def stored_field(store: Store, record: SolutionRecord) -> StoredField:
    """Return the field of a stored solution.

    Raises
    ------
    Unusable
        An older version stored the solution without its covariance.
    """
    solution = stored_solution(record.doc, record.id)
    if solution.prediction is None:
        raise Unusable(f"solution {record.id} has no covariance: an older version of Abbe stored it", "solve again")
    terms, coefficients, covariance = solution.prediction.unpacked()
    machine = machine_from_doc(store.machines.get(store.campaigns.find(record.campaign_id).machine_id).doc)
    motions = solution.motions
    statuses = {name: m.status for name, m in motions.items()}
    means = {name: (m.value, m.u) for name, m in solution.mean_over_volume.items()}
    hidden = {name: m.reason or HIDDEN for name, m in motions.items() if m.status == HIDDEN}
    known = KnownField(machine, terms, coefficients, covariance, solution.prediction.scatter_mm)
    return StoredField(record.id, known, hidden, statuses, means)


def node_map(stored: StoredField, nodes: int, motions: Sequence[str] = ()) -> NodeMap:
    """Map deviation and uncertainty on a grid of ``nodes`` points per axis over the strokes, for the given motions or all together.

    Raises
    ------
    NotObservable, Unusable
        As `StoredField.observable_motions`.
    """
    chosen = stored.observable_motions(motions) if motions else None
    points = volume_grid(stored.known.machine.stroke_mm, nodes)
    found = field_map(stored.known, points, chosen)
    u = standard_uncertainty_mm(found.deviation_mm, found.covariance_mm2)
    return NodeMap(nodes, points, found.deviation_mm * UM, u * UM, apart_from_zero(found.deviation_mm, found.covariance_mm2))
