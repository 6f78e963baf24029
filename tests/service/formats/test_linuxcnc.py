"""COMP_FILEs that we wrote, loaded by the real LinuxCNC, and what it adds read back: both types, both directions, between the points."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from abbe.service.formats.files import FormatSettings
from abbe.service.formats.model import AxisTable, Compensation, correction_at
from abbe.service.formats.registry import FORMATS
from tests.conftest import Require

HUNDREDTHS_OF_NM = 5e-8
"""What the end of a move leaves open, mm; the files' unit is 1 nm."""
TOLD = FormatSettings(reference_mm=(0.0, 0.0, 0.0))
SCRIPT = """mount -t tmpfs tmpfs /tmp && ip link set lo up && cd "$1" && export LINUXCNC_RUNDIR=/tmp/r
mkdir -p /tmp/r && chmod 1777 /tmp/r
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


def test_linuxcnc_adds_what_the_tables_say(control: Path) -> None:
    parts = _tables()
    read = []
    for comp, key in zip(parts, ("linuxcnc-1", "linuxcnc-0"), strict=True):
        files = FORMATS[key].write(comp, TOLD)
        read.append(FORMATS[key].read(files, TOLD))
        for f in files:
            (control / f.name).write_text(f.text)
    probe = Path(__file__).with_name("linuxcnc_probe.py")
    shutil.copy(probe, control)
    apart = ["unshare", "-n", "-i", "-p", "-f", "--mount-proc", "-m", "sh", "-c", SCRIPT, "sh", str(control), str(control / probe.name)]
    said = subprocess.run(apart, capture_output=True, text=True, timeout=100, check=False)
    assert (control / "seen.json").exists(), said.stdout + said.stderr
    rows = json.loads((control / "seen.json").read_text())
    at = np.array([[r["at"][0], 0.0, r["at"][1]] for r in rows])
    way = np.array([[r["way"], 1.0, r["way"]] for r in rows])
    seen = np.array([r["added"] for r in rows])
    assert len(rows) == 20
    assert np.abs(seen).max() > 0.02
    for comps, limit_mm in ((read, HUNDREDTHS_OF_NM), (parts, 0.5e-6 + HUNDREDTHS_OF_NM)):
        both = Compensation(comps[0].tables + comps[1].tables)
        assert np.abs(correction_at(both, at, way)[:, [0, 2]] - seen).max() <= limit_mm
