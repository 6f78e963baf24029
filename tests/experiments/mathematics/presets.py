"""Machines by name: which carriage carries what, so that nobody has to work the chain out from a drawing.

A preset is the chain only; strokes, pivots and tool are the user's: ``Machine(preset("MB1").chain, stroke_mm)``.
"""

from __future__ import annotations

from dataclasses import dataclass

from abbe.models.notation import pahk, yang
from abbe.models.papers.wang import model as wang


@dataclass(frozen=True, slots=True)
class Preset:
    """A usual arrangement of three axes.

    Parameters
    ----------
    name : str
    chain : str
        From workpiece w over bed b to tool t, e.g. ``"w-X-Y-b-Z-t"``.
    text : str
        In words, what carries what.
    """

    name: str
    chain: str
    text: str


_PAHK = {
    "MB1": "moving bridge: workpiece fixed; the bridge runs along Y, on it the X carriage, in it the Z ram with the probe",
    "MB2": "moving bridge: workpiece fixed; the bridge runs along X, on it the Y carriage, in it the Z ram with the probe",
    "FB1": "fixed bridge: the table carries the workpiece along Y; on the bridge the X carriage with the Z ram",
    "FB2": "fixed bridge: the table carries the workpiece along X; on the bridge the Y carriage with the Z ram",
    "MH1": "moving horizontal arm: workpiece fixed; column along Y, on it the Z slide, on it the arm along X",
    "MH2": "moving horizontal arm: workpiece fixed; column along X, on it the Z slide, on it the arm along Y",
    "FH1": "fixed horizontal arm: the table carries the workpiece along X; column along Y, on it the Z slide; the arm is a probe offset",
    "FH2": "fixed horizontal arm: the table carries the workpiece along Y; column along X, on it the Z slide; the arm is a probe offset",
    "CX": "column: the workpiece lies on the Y table, which rides on the X slide; the Z ram sits in the fixed column",
    "CY": "column: the workpiece lies on the X table, which rides on the Y slide; the Z ram sits in the fixed column",
}

_USUAL = (
    Preset("T-10", yang.CHAIN, "machining centre of Yang and Kim: workpiece on the Z cross slide; saddle X, on it the spindle carrier Y"),
    Preset("FXYZ", wang.CHAIN, "Wang's FXYZ: workpiece fixed; X carries Y, Y carries Z, Z carries the tool"),
    Preset("vmc-c-frame", "w-X-Y-b-Z-t", "vertical, C-frame: table X on saddle Y on the bed; the head runs along Z on the fixed column"),
    Preset("vmc-bridge", "w-X-b-Y-Z-t", "vertical, double column: table X on the bed; saddle Y on the fixed crossbeam, on it the ram Z"),
    Preset("vmc-gantry", "w-b-X-Y-Z-t", "vertical, gantry: table fixed; the bridge runs along X, on it saddle Y, on it the ram Z"),
    Preset("vmc-travelling-column", "w-b-X-Y-Z-t", "vertical: long fixed table; the column runs along X, on it Y, on it the head Z"),
    Preset("vmc-knee", "w-X-Y-Z-b-t", "vertical knee mill: table X on saddle Y on the knee Z; the spindle stands still"),
    Preset("hmc-table-z", "w-Z-b-X-Y-t", "horizontal: table Z on the bed; the column runs along X, the head Y on it"),
    Preset("hmc-column-z", "w-X-b-Z-Y-t", "horizontal: table X on the bed; the column runs along Z, the head Y on it"),
    Preset("hmc-cross-table", "w-X-Z-b-Y-t", "horizontal: table X on saddle Z on the bed; the head Y on the fixed column"),
    Preset(
        "hmc-travelling-column",
        "w-b-X-Z-Y-t",
        "horizontal: table fixed; slide X, on it the column along Z, the head Y on it",
    ),
    Preset(
        "boring-mill",
        "w-b-X-Y-Z-t",
        "horizontal, floor type: plate fixed; column X, the headstock Y on it, the ram Z in that",
    ),
)

PRESETS: dict[str, Preset] = {
    preset.name: preset
    for preset in (*(Preset(name, kind.chain, f"Pahk {name}, {_PAHK[name]}") for name, kind in pahk.TYPES.items()), *_USUAL)
}
"""All presets by name: Pahk's ten types, the machines of the other papers, the usual machining centres."""


def preset(name: str) -> Preset:
    """One preset by its name; capital and small letters alike.

    Raises
    ------
    ValueError
        There is none of that name; the message lists the names.
    """
    for known, found in PRESETS.items():
        if known.lower() == name.lower():
            return found
    raise ValueError(f"preset {name!r}: expected one of {', '.join(PRESETS)}")
