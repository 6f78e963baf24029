"""Registry of all formats by key, with limits, writer and reader."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from abbe.service.errors import FormatRefused
from abbe.service.formats import (
    centroid,
    fanuc_lattice,
    fanuc_pitch,
    heidenhain,
    heidenhain_kinematics,
    isg,
    linuxcnc_comp,
    linuxcnc_hal,
    linuxcnc_kins,
    mach4,
    siemens_cec,
    siemens_eec,
    skew,
)
from abbe.service.formats.files import FormatSettings, TextFile
from abbe.service.formats.model import Compensation
from abbe.service.formats.rules import FormatLimits, SignRule

Write = Callable[[Compensation, FormatSettings], tuple[TextFile, ...]]
Read = Callable[[tuple[TextFile, ...], FormatSettings], Compensation]


@dataclass(frozen=True, slots=True)
class Format:
    """A format: ``key`` for the command line, ``name`` for people, ``live``: how a loaded file becomes active."""

    key: str
    name: str
    limits: FormatLimits
    sign: SignRule
    write: Write
    read: Read
    live: str


FORMATS: dict[str, Format] = {
    f.key: f
    for f in (
        Format("isg", "Beckhoff/ISG volumetric CSV (neutral)", isg.LIMITS, isg.SIGN, isg.write, isg.read, "#VOLCOMP in the NC program"),
        Format(
            "linuxcnc-1",
            "LinuxCNC COMP_FILE type 1",
            linuxcnc_comp.LIMITS,
            linuxcnc_comp.SIGNS[1],
            partial(linuxcnc_comp.write, kind=1),
            partial(linuxcnc_comp.read, kind=1),
            "restart of LinuxCNC, home",
        ),
        Format(
            "linuxcnc-0",
            "LinuxCNC COMP_FILE type 0",
            linuxcnc_comp.LIMITS,
            linuxcnc_comp.SIGNS[0],
            partial(linuxcnc_comp.write, kind=0),
            partial(linuxcnc_comp.read, kind=0),
            "restart of LinuxCNC, home",
        ),
        Format(
            "linuxcnc-hal",
            "LinuxCNC HAL network",
            linuxcnc_hal.LIMITS,
            linuxcnc_hal.SIGN,
            linuxcnc_hal.write,
            linuxcnc_hal.read,
            "at once (halcmd), with the machine at rest",
        ),
        Format(
            "linuxcnc-kins",
            "LinuxCNC kinematics component",
            linuxcnc_kins.LIMITS,
            linuxcnc_kins.SIGN,
            linuxcnc_kins.write,
            linuxcnc_kins.read,
            "install and restart; then at once by a HAL pin, with the machine at rest",
        ),
        Format(
            "siemens-eec",
            "Siemens ENC_COMP",
            siemens_eec.LIMITS,
            siemens_eec.SIGN,
            siemens_eec.write,
            siemens_eec.read,
            "load with MD32700 = 0, then set it to 1, reset, reference the axis",
        ),
        Format(
            "siemens-cec",
            "Siemens CEC",
            siemens_cec.LIMITS,
            siemens_cec.SIGN,
            siemens_cec.write,
            siemens_cec.read,
            "load with MD32710 = 0, then set it to 1; SD41300 switches tables",
        ),
        Format(
            "fanuc-pitch",
            "Fanuc stored pitch error compensation",
            fanuc_pitch.LIMITS,
            fanuc_pitch.SIGN,
            fanuc_pitch.write,
            fanuc_pitch.read,
            "power off and on, G28",
        ),
        Format(
            "fanuc-lattice",
            "Fanuc 3-D error compensation (sheet)",
            fanuc_lattice.LIMITS,
            fanuc_lattice.SIGN,
            fanuc_lattice.write,
            fanuc_lattice.read,
            "entered by hand; power off and on, G28",
        ),
        Format(
            "heidenhain",
            "Heidenhain .COM and .CMA",
            heidenhain.LIMITS,
            heidenhain.SIGN,
            heidenhain.write,
            heidenhain.read,
            "active line (*) of the .CMA",
        ),
        Format(
            "heidenhain-kinematics",
            "Heidenhain KinematicsComp, columns C1 to C6",
            heidenhain_kinematics.LIMITS,
            heidenhain_kinematics.SIGN,
            heidenhain_kinematics.write,
            heidenhain_kinematics.read,
            "active line (*) of the .CMA, with COMPTAB entries in the kinematics description",
        ),
        Format("mach4", "Mach4 screw map (sheet)", mach4.LIMITS, mach4.SIGN, mach4.write, mach4.read, "entered by hand"),
        Format(
            "centroid",
            "Centroid ballscrew table, version 3",
            centroid.LIMITS,
            centroid.SIGN,
            centroid.write,
            centroid.read,
            "restart of the control",
        ),
        *(
            Format(key, name, d.limits, skew.SIGN, partial(skew.write, dialect=d), partial(skew.read, dialect=d), live)
            for key, name, d, live in (
                ("marlin", "Marlin M852 and M425", skew.MARLIN, "at once; M500 keeps it"),
                ("klipper", "Klipper SET_SKEW", skew.KLIPPER, "at once; after a restart: SKEW_PROFILE LOAD=abbe"),
                ("grblhal", "grblHAL $160 to $162", skew.GRBLHAL, "at once"),
            )
        ),
    )
}


def format_of(key: str) -> Format:
    """Return the format with this key.

    Raises
    ------
    FormatRefused
        The key is unknown; the message lists the known ones.
    """
    if key not in FORMATS:
        raise FormatRefused(f"there is no format {key!r}", f"known are {', '.join(FORMATS)}")
    return FORMATS[key]
