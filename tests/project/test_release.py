"""What a release needs is there: licence files, one version, a changelog that tells of it, archives that hold what README needs."""

from __future__ import annotations

import base64
import hashlib
import importlib.metadata
import importlib.util
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from tests.conftest import LONG, ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_one_version_is_told_alike() -> None:
    """Only pyproject.toml states it; CITATION.cff has to repeat it, and the changelog tells of it or of what comes next."""
    assert f"\nversion: {PROJECT['version']}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(rf"^## (Unreleased|{re.escape(PROJECT['version'])} )", changes, re.MULTILINE)
    stated = [path.name for path in ROOT.glob("abbe/*.py") if "__version__ =" in path.read_text(encoding="utf-8")]
    assert stated == []


def test_licence_and_notice_are_the_whole_texts() -> None:
    text = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert "Apache License" in text
    assert "END OF TERMS AND CONDITIONS" in text
    assert (PROJECT["license"], PROJECT["license-files"]) == ("Apache-2.0", ["LICENSE", "NOTICE"])
    supported = {line.rpartition(" ")[2] for line in PROJECT["classifiers"] if re.search(r"3\.\d+$", line)}
    assert supported == {"3.11", "3.12", "3.13", "3.14"}


def test_the_wheel_carries_four_packages_of_others_with_their_licences() -> None:
    """NOTICE says so: nothing that somebody else wrote but uPlot, nodesets of OPC UA and two fonts, where they were fetched."""
    foreign = re.compile(r"\.(ttf|otf|woff2?|min\.js|min\.css|xml)$")
    parts = [ROOT / part for part in ("service", "drivers", "models", "simulators")]
    found = {path for part in parts for path in part.rglob("*") if foreign.search(path.name)}
    fonts = ("service/rendering/fonts/japanese", "service/rendering/fonts/korean")
    folders = ("service/web/static/uplot", "service/plant/opcua/nodesets", *fonts)
    assert {path.parent for path in found} <= {ROOT / folder for folder in folders}
    others = {path.parent for path in found} - {ROOT / folder for folder in fonts}
    assert all("Copyright" in (folder / "LICENSE").read_text(encoding="utf-8") for folder in others)
    licences = [path / "LICENSE_FONT" for font in fonts if (path := ROOT / font).exists()]
    assert all("OPEN FONT LICENSE" in path.read_text(encoding="utf-8") for path in licences)
    for folder in folders:
        assert subprocess.run(["git", "check-ignore", "-q", f"{folder}/version"], cwd=ROOT, check=False).returncode in {0, 128}


def npm_files() -> ModuleType:
    spec = importlib.util.spec_from_file_location("npm_files", ROOT / "deploy" / "npm_files.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["npm_files"] = module
    spec.loader.exec_module(module)
    return module


def test_files_of_others_come_whole_and_as_pinned_or_not_at_all(tmp_path: Path) -> None:
    package, scratch, folder = tmp_path / "thing-1.0.tgz", tmp_path / "scratch", tmp_path / "product" / "thing"
    scratch.mkdir()
    folder.parent.mkdir()
    with tarfile.open(package, "w:gz") as archive:
        for name in ("a.js", "LICENSE"):
            (tmp_path / name).write_text(name)
            archive.add(tmp_path / name, f"package/{name}")
    npm = [sys.executable, "-c", f"import shutil, sys; shutil.copy({str(package)!r}, sys.argv[-1])"]
    digest = base64.b64encode(hashlib.sha512(package.read_bytes()).digest()).decode()
    wanted = npm_files().NpmFiles("thing", "1.0", digest, ("a.js", "LICENSE"), folder, "nothing can be done")
    with pytest.raises(ValueError, match="does not have the pinned hash"):
        replace(wanted, sha512="0" * 88).fetch(npm, scratch)
    with pytest.raises(KeyError):
        replace(wanted, files=("b.js",)).fetch(npm, scratch)
    assert list(folder.parent.iterdir()) == []
    wanted.fetch(npm, scratch)
    assert wanted.present
    (folder / "LICENSE").unlink()
    assert not wanted.present


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """The names in wheel and source archive, built with what is installed here, which takes half a minute beside other work."""
    if not LONG:
        pytest.skip("archives are built in the long run, and by `make release`")
    out = tmp_path_factory.mktemp("dist")
    program = (
        "import os, sys; from setuptools import build_meta; os.chdir(sys.argv[1]); "
        "build_meta.build_sdist(sys.argv[2]); build_meta.build_wheel(sys.argv[2])"
    )
    tree = tmp_path_factory.mktemp("tree")
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, capture_output=True, check=False)
    if archive.returncode != 0:
        pytest.skip("not a git repository")
    subprocess.run(["tar", "-x", "-C", str(tree)], input=archive.stdout, check=True)
    subprocess.run([sys.executable, "-c", program, str(tree), str(out)], capture_output=True, check=True)
    found = {}
    for path in out.iterdir():
        if path.suffix == ".whl":
            found["wheel"] = set(zipfile.ZipFile(path).namelist())
        else:
            with tarfile.open(path) as tar:
                found["sdist"] = {Path(name).relative_to(Path(name).parts[0]).as_posix() for name in tar.getnames()}
    return found


@pytest.mark.timeout(900)
def test_archives_hold_what_readme_needs(archives: dict[str, set[str]]) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    linked = {target.split("#")[0] for target in re.findall(r"\]\(([^)]+)\)", readme)}
    missing = {target for target in linked if not any(name == target or name.startswith(target) for name in archives["sdist"])}
    assert missing == set()
    assert {"Makefile", "requirements.lock", "deploy/machine.example.toml", "LICENSE", "NOTICE", "tests/conftest.py"} <= archives["sdist"]
    wheel = archives["wheel"]
    assert {name.split("/")[0] for name in wheel} == {"abbe", f"abbe-{PROJECT['version']}.dist-info"}
    kept = {name.rpartition("/")[2] for name in wheel if "/licenses/" in name}
    assert kept == {"LICENSE", "NOTICE"}
    for needed in (
        "abbe/py.typed",
        "abbe/service/py.typed",
        "abbe/service/rendering/templates/document.typ",
        "abbe/simulators/scenarios/vmc.toml",
    ):
        assert needed in wheel


def test_what_is_installed_is_abbe() -> None:
    assert importlib.metadata.metadata("abbe")["License-Expression"] == "Apache-2.0"
