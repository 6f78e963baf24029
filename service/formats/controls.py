"""Capabilities of controls from their documents: kinds, number and resolution of tables, and order of action (controllers.md 1, 5)."""

from __future__ import annotations

from dataclasses import dataclass

from abbe.service.errors import FormatRefused
from abbe.service.formats.model import Lookup


@dataclass(frozen=True, slots=True)
class ControlModel:
    """One control.

    Attributes
    ----------
    own, cross : str
        Format of own-axis tables; format of cross and product tables; empty for none.
    own_points, cross_points : int
        Points of a table.
    both_directions : bool
        Own-axis tables have two columns. Otherwise the control's backlash parameter holds the lost motion.
    tables : int, optional
        Largest number of tables of the ``cross`` format, of which a product takes two; None: unlimited.
    lattice, nodes : str, int
        Format of a 3-D grid; nodes per axis.
    motions : str
        Format of error motions for the control's own kinematic chain.
    lookup : str
        Argument of all tables but the own-axis ones.
    unit_mm : float
        Unit of the numbers in the tables.
    """

    key: str
    name: str
    own: str = ""
    own_points: int = 25
    both_directions: bool = True
    cross: str = ""
    cross_points: int = 25
    products: bool = False
    tables: int | None = None
    lattice: str = ""
    nodes: int = 0
    motions: str = ""
    lookup: Lookup = "command"
    unit_mm: float = 1e-6


CONTROLS: dict[str, ControlModel] = {
    c.key: c
    for c in (
        ControlModel(
            "linuxcnc",
            "LinuxCNC: COMP_FILE and HAL network",
            own="linuxcnc-1",
            own_points=101,
            cross="linuxcnc-hal",
            cross_points=16,
            products=True,
        ),
        ControlModel(
            "siemens-840d",
            "SINUMERIK 840D sl: ENC_COMP and CEC",
            own="siemens-eec",
            own_points=101,
            both_directions=False,
            cross="siemens-cec",
            products=True,
        ),
        ControlModel(
            "siemens-828d",
            "SINUMERIK 828D with the option: ENC_COMP and 8 CEC tables",
            own="siemens-eec",
            own_points=101,
            both_directions=False,
            cross="siemens-cec",
            products=True,
            tables=8,
        ),
        ControlModel("fanuc", "Fanuc with pitch error compensation only", own="fanuc-pitch", own_points=101, unit_mm=1e-3),
        ControlModel(
            "fanuc-30i", "Fanuc 30i with 3-D error compensation", own="fanuc-pitch", lattice="fanuc-lattice", nodes=9, unit_mm=1e-3
        ),
        ControlModel(
            "heidenhain",
            "Heidenhain TNC: .COM tables",
            own="heidenhain",
            own_points=101,
            cross_points=101,
            cross="heidenhain",
            unit_mm=1e-4,
        ),
        ControlModel("isg", "Beckhoff/ISG kernel with TF5280", motions="isg"),
        ControlModel("mach4", "Mach4", own="mach4", own_points=101, unit_mm=1e-4),
        ControlModel("centroid", "Centroid, table version 1", own="centroid", own_points=101, both_directions=False, unit_mm=1e-3),
    )
}


def control_of(key: str) -> ControlModel:
    """The control of a key.

    Raises
    ------
    FormatRefused
        The key is unknown; the message lists the known ones.
    """
    if key not in CONTROLS:
        raise FormatRefused(f"there is no control {key!r}", f"known are {', '.join(CONTROLS)}")
    return CONTROLS[key]
