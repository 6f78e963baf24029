"""What we wrote for LinuxCNC, loaded by the real one, and what it adds read back.

COMP_FILEs: both types, both directions, between the points. The kinematics component: before, in force, and back to nothing.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from abbe.service.compensation.comp_export import export
from abbe.service.formats.files import FormatSettings
from abbe.service.formats.model import AxisTable, Compensation, correction_at
from abbe.service.formats.registry import FORMATS
from tests.conftest import Require
from tests.service.formats.test_choice import _known

HUNDREDTHS_OF_NM = 5e-8
"""What the end of a move leaves open, mm; the files' unit is 1 nm."""
TOLD = FormatSettings(reference_mm=(0.0, 0.0, 0.0))
SCRIPT = """mount -t tmpfs tmpfs /tmp && ip link set lo up && cd "$1" && export LINUXCNC_RUNDIR=/tmp/r
mkdir -p /tmp/r && chmod 1777 /tmp/r
if [ -e abbekins.so ]; then # beside the control's own modules, in this namespace only
    own=$(dirname "$(dpkg -L linuxcnc-uspace | grep /trivkins.so)") && mount --bind "$own" /mnt && mount -t tmpfs tmpfs "$own"
    ln -s /mnt/* "$own" && cp abbekins.so "$own"
fi
./start2.sh simpy.ini && RTAPI_UID=65534 RTAPI_FIFO_PATH=/tmp/r/rtapi_fifo HOME=/tmp/r timeout 60 /usr/bin/python3 "$2" "$1/seen.json"
./stop2.sh
"""


@pytest.fixture
def control(shared: Path, require: Require) -> Iterator[Path]:
    """The simulated three-axis machine of the shared example, in a folder that a private /tmp does not hide."""
    require("linuxcnc", shutil.which("halcmd") is not None and os.geteuid() == 0, "linuxcnc-uspace is not installed, or this is not root")
    able = subprocess.run(["unshare", "-n", "-i", "-p", "-f", "--mount-proc", "-m", "true"], capture_output=True, check=False)
    require("linuxcnc", able.returncode == 0, "namespaces are not allowed here")
    folder = Path(tempfile.mkdtemp(prefix="abbe-linuxcnc-", dir="/var/tmp"))
    folder.chmod(0o777)
    for source in (shared / "examples" / "linuxcnc").iterdir():
        shutil.copy(source, folder)
        (folder / source.name).chmod(0o755)
    listed = subprocess.run(["dpkg", "-L", "linuxcnc-uspace"], capture_output=True, text=True, check=True).stdout.split()
    nml = Path(next(name for name in listed if name.endswith("linuxcnc.nml"))).read_text()
    (folder / "local.nml").write_text(nml.replace("TCP=5005 xdr", ""))  # without it, no socket is opened
    yield folder
    shutil.rmtree(folder)


def _tables() -> tuple[Compensation, Compensation]:
    rng = np.random.default_rng(7)
    x, z = np.linspace(0, 500, 101), np.linspace(-300, 0, 61)
    over_x, over_z = (np.cumsum(rng.normal(size=p.size)) * 2e-3 for p in (x, z))
    over_x, over_z = over_x - over_x[0], over_z - over_z[-1]
    return (
        Compensation((AxisTable("X", "X", x, over_x, over_x - 0.004 - 1e-6 * x),)),
        Compensation((AxisTable("Z", "Z", z, over_z, over_z - 0.003),)),
    )


def _seen(control: Path, name: str) -> list[dict[str, Any]]:
    """Start the control, run a probe beside it, end it; return what the probe saw."""
    for script in (name, "probe_control.py"):
        shutil.copy(Path(__file__).with_name(script), control)
    apart = ["unshare", "-n", "-i", "-p", "-f", "--mount-proc", "-m", "sh", "-c", SCRIPT, "sh", str(control), str(control / name)]
    said = subprocess.run(apart, capture_output=True, text=True, timeout=100, check=False)
    assert (control / "seen.json").exists(), said.stdout + said.stderr + (control / "run.log").read_text()
    return list(json.loads((control / "seen.json").read_text()))


def test_linuxcnc_adds_what_the_tables_say(control: Path) -> None:
    parts = _tables()
    read = []
    for comp, key in zip(parts, ("linuxcnc-1", "linuxcnc-0"), strict=True):
        files = FORMATS[key].write(comp, TOLD)
        read.append(FORMATS[key].read(files, TOLD))
        for f in files:
            (control / f.name).write_text(f.text)
    rows = _seen(control, "linuxcnc_probe.py")
    at = np.array([[r["at"][0], 0.0, r["at"][1]] for r in rows])
    way = np.array([[r["way"], 1.0, r["way"]] for r in rows])
    seen = np.array([r["added"] for r in rows])
    assert len(rows) == 20
    assert np.abs(seen).max() > 0.02
    for comps, limit_mm in ((read, HUNDREDTHS_OF_NM), (parts, 0.5e-6 + HUNDREDTHS_OF_NM)):
        both = Compensation(comps[0].tables + comps[1].tables)
        assert np.abs(correction_at(both, at, way)[:, [0, 2]] - seen).max() <= limit_mm


def test_kinematics_component_corrects_the_whole_volume_and_goes_back_to_nothing(control: Path, require: Require) -> None:
    """A field of 18 motions and squareness, exported, compiled by halcompile and run: at 25 places at most 0.3 µm rms are left."""
    require("linuxcnc", shutil.which("halcompile") is not None, "linuxcnc-uspace-dev is not installed")
    known = _known(lost=(0.0, 0.0, 0.0))
    (file,) = export(known, "linuxcnc-kins", np.array([0.0, 0.0, 0.0])).files
    (control / file.name).write_text(file.text)
    subprocess.run(["halcompile", "--compile", file.name], cwd=control, check=True, capture_output=True, timeout=60)
    _use_kinematics(control)
    rows = _seen(control, "kinematics_probe.py")
    assert [(r["phase"], len(r["at"])) for r in rows] == [("before", 5), ("in force", 25), ("back", 5)]
    for r in (rows[0], rows[2]):
        assert np.abs(np.array(r["added"])).max() < HUNDREDTHS_OF_NM
    at, added = np.array(rows[1]["at"]), np.array(rows[1]["added"])
    zero = known.deviation_mm(np.zeros((1, 3)))
    wanted = known.deviation_mm(at) - zero
    left = np.linalg.norm(wanted + added, axis=1)
    rms = float(np.sqrt(np.mean(left**2)))
    assert np.sqrt(np.mean(np.sum(wanted**2, axis=1))) > 0.010
    assert rms <= 0.0003, f"{rms * 1e3:.3f} um rms"


def _use_kinematics(control: Path) -> None:
    """Change the example's machine: our kinematics, no tables of its own, the stroke of the identified machine."""
    ini = (control / "simpy.ini").read_text()
    lines = [line for line in ini.splitlines() if not line.startswith(("COMP_FILE", "BACKLASH"))]
    text = "\n".join(lines).replace("trivkins coordinates=XYZ", "abbekins").replace("MIN_LIMIT = -10\n", "MIN_LIMIT = -210\n")
    text = re.sub(r"(VELOCITY|ACCELERATION) = (\d+)", r"\1 = \g<2>00", text)  # no drive has to follow
    (control / "simpy.ini").write_text(text + "\n")
    hal, controller = (control / "sim.hal").read_text(), "addf motion-controller servo-thread"
    (control / "sim.hal").write_text(hal.replace(controller, f"{controller}\naddf abbekins.update servo-thread"))
