"""A real file system without room, segment and database on it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

MOUNT = "mount -t tmpfs -o size={size}k none {folder} && exec {python} -m tests.service.capture.small_disk {folder}"


@pytest.mark.parametrize("size", [3000])
def test_a_run_on_a_full_disk_is_closed_and_keeps_what_was_acknowledged(tmp_path: Path, size: int, require) -> None:
    unshare = shutil.which("unshare")
    tried = subprocess.run([unshare or "false", "-rm", "mount", "-t", "tmpfs", "none", str(tmp_path)], capture_output=True, check=False)
    require("tmpfs", tried.returncode == 0, "a file system of its own cannot be mounted here")
    script = MOUNT.format(size=size, folder=tmp_path, python=sys.executable)
    done = subprocess.run([unshare, "-rm", "sh", "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert "no space left" in found["told"] or "no disk space" in found["told"]
    assert found["durable"] > 2000
    assert found["stored"] == [0, found["durable"], found["durable"] + 1]
    assert (found["unaccounted"], found["whole"], found["closed"], found["status"]) == ([], True, True, "disk_full")
