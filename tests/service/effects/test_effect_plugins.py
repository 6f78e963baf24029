"""A user's own effect: a real distribution on the path, found by its entry point; a broken one is left out by name."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from abbe.models.effects.catalogue import CATALOGUE
from abbe.service.effects.effect_catalogue import Plugins, installed

GOOD = """
import numpy as np
from abbe.models.effects.columns import of_machine, along, first
from abbe.models.effects.effect import Effect

EFFECT = Effect(
    name="{name}", title="table clamp", family="structure", keys=("Z",), unit="um", per_unit=1.0, typical=(1.0, 20.0), shape=(),
    signal=of_machine(lambda at, key, values: along(2, 1e-3 * np.tanh({slope} * (at.q_mm[:, 0] - 300.0)))),
    strength=first, needs="runs on both sides of the clamp", signature="a smooth step in Z over X", remedy="mechanics",
    remedy_text="tighten the clamp", source="our shop",
)
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty site directory on the path."""
    monkeypatch.syspath_prepend(str(tmp_path))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("shop_"):
            del sys.modules[name]


def distribute(site: Path, module: str, text: str, entry: str = "EFFECT") -> None:
    """Install a package of one module: the module and a dist-info with its entry point."""
    (site / f"{module}.py").write_text(text)
    info = site / f"{module}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module.replace('_', '-')}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[abbe.effects]\n{module} = {module}:{entry}\n")
    importlib.invalidate_caches()


def found() -> Plugins:
    return installed(e.name for e in CATALOGUE)


def test_an_effect_of_another_package_is_found_and_another_beside_it_too(site: Path) -> None:
    assert found() == Plugins((), ())
    distribute(site, "shop_clamp", GOOD.format(name="clamp_step", slope=0.05))
    distribute(site, "shop_door", GOOD.format(name="door_step", slope=0.1).replace("EFFECT = ", "ONE = ") + "\nALL = (ONE,)\n", "ALL")
    both = found()
    assert [e.name for e in both.effects] == ["clamp_step", "door_step"]
    assert both.broken == ()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("import no_such_module_of_ours", "ModuleNotFoundError"),
        ("EFFECT = 3", "expected an Effect or a tuple of Effects, got int"),
        ("EFFECT = ()", "offers no effect"),
        ("x = 1", "AttributeError"),
        (GOOD.format(name="backlash", slope=1.0), "the name 'backlash' is taken"),
        (
            GOOD.format(name="shop_scatter", slope=1.0).replace('source="our shop"', 'source="our shop", kind="variance"'),
            "shop_scatter: kind 'variance': expected 'mean'",
        ),
        (GOOD.format(name="Clamp Step", slope=1.0), "lower-case letters"),
        (GOOD.format(name="clamp_step", slope="np.nan"), "not finite"),
        (GOOD.format(name="clamp_step", slope="missing"), "NameError"),
        (GOOD.format(name="clamp_step", slope=1.0).replace('unit="um"', 'unit="parsec"'), "unit 'parsec'"),
        (
            GOOD.format(name="clamp_step", slope=1.0).replace("source=", 'blind=("laser_diagonal",), source='),
            "the effect lists laser_diagonal in `blind`",
        ),
    ],
)
def test_a_broken_one_is_left_out_with_one_error_and_the_others_stay(site: Path, text: str, why: str) -> None:
    distribute(site, "shop_good", GOOD.format(name="good_step", slope=0.05))
    distribute(site, "shop_bad", text)
    both = found()
    assert [e.name for e in both.effects] == ["good_step"]
    (fault,) = both.broken
    assert fault.code == "DIS-003"
    assert "shop_bad of shop-bad (shop_bad:EFFECT) is left out" in str(fault)
    assert why in str(fault)


def test_the_notebook_that_explains_it_is_a_module_as_its_page_says(site: Path) -> None:
    docs = Path(__file__).parents[3] / "docs"
    cells = json.loads((docs / "notebooks" / "own-effect.ipynb").read_text(encoding="utf-8"))["cells"]
    distribute(site, "shop_clamp", "".join(next(cell for cell in cells if cell["cell_type"] == "code")["source"]))
    assert "shop_clamp:EFFECT" in (docs / "how-to" / "own-effect.md").read_text(encoding="utf-8")
    assert [e.name for e in found().effects] == ["clamp_step"]


def test_two_packages_cannot_have_one_name(site: Path) -> None:
    distribute(site, "shop_a", GOOD.format(name="clamp_step", slope=0.05))
    distribute(site, "shop_b", GOOD.format(name="clamp_step", slope=0.1))
    both = found()
    assert [e.name for e in both.effects] == ["clamp_step"]
    assert "shop_b" in str(both.broken[0])
    assert "is taken" in str(both.broken[0])
