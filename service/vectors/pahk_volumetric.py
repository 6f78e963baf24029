"""`pahk_volumetric.json`: deviation of the ten types, first order and with two kinds of finite rotation (math.md 2)."""

from __future__ import annotations

import numpy as np

from abbe.models.notation.pahk import PahkType, motions_from_pahk, pahk_machine, pahk_type
from abbe.models.papers.pahk.volume_map import Form, chain_deviation_mm
from abbe.service.errors import FileFormatError
from abbe.service.vectors.case import VectorCase
from abbe.service.vectors.checks import Checks
from abbe.service.vectors.pahk_parameters import pair, squareness

SUBTRACTED = "coordinates of up to 900 mm were subtracted"
FORMS: dict[str, tuple[Form, float, str]] = {
    "delta_first_order": ("first", 1e-13, SUBTRACTED),
    "delta_exact_rot": ("zyx", 3e-13, SUBTRACTED),
    "delta_paper_matrix": ("small", 3e-13, SUBTRACTED),
}
"""Key of the file, form of the chain, rounding of the stored number in mm and its reason."""


def read(case: VectorCase, checks: Checks) -> None:
    """Compare every deviation of every type."""
    for name, part in case.at("types").items():
        kind = pahk_type(name)
        ours, theirs = kind.chain.replace("-", "").removeprefix("w").removesuffix("t").replace("b", "F"), part.text("chain")
        if ours != theirs:
            raise FileFormatError(f"{part.label}/chain: {name} is {ours}, the file says {theirs}", "compare with math.md 2")
        checks.compare("sign of alpha", kind.alpha_sign, part.at("alpha_sign"), unit="1")
        for point in part.at("cases").parts():
            _point(kind, point, checks)


def _point(kind: PahkType, point: VectorCase, checks: Checks) -> None:
    axes = point.array("X", shape=(3,))[None]
    machine = pahk_machine(kind, np.array([[0.0, 1.0]] * 3), point.array("probe", shape=(3,)))
    motions = motions_from_pahk(kind, axes, pair(point, "d")[None], pair(point, "E")[None], squareness(point))
    for key, (form, floor, why) in FORMS.items():
        checks.compare(
            key, chain_deviation_mm(machine, axes, motions, form)[0], point.at(key), unit="mm", floor=floor, rounding=why, relative=0.0
        )
