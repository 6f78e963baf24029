import itertools
import tomllib

import pytest

from abbe.simulators import scenario
from abbe.simulators.scenario import Scenario, ScenarioError, from_dict, load, parse_chain


def test_packaged_file_states_every_default() -> None:
    assert load() == Scenario()
    data = tomllib.loads(scenario.DEFAULT_PATH.read_text(encoding="utf-8"))
    assert set(data) == set(Scenario.__slots__)
    assert set(data["magnitudes"]) == set(scenario.Magnitudes.__slots__)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"sed": 1}, "unknown key: sed"),
        ({"machine": {"chains": "w"}}, "unknown key: machine.chains"),
        ({"machine": {"stroke_mm": {"A": [0, 1]}}}, "unknown key: machine.stroke_mm.A"),
        ({"seed": "one"}, "seed: 'one' is not of type int"),
        ({"seed": True}, "seed: True is not of type int"),
        ({"seed": -1}, "seed: must not be negative"),
        ({"boot_id": 2**32}, "boot_id: must be 0..4294967295"),
        ({"speed": 0.0}, "speed: must be above 0"),
        ({"machine": 3}, "machine: a table is expected"),
        ({"machine": {"tool_mm": [0, 0]}}, "machine.tool_mm: a list of 3 numbers is expected"),
        ({"machine": {"stroke_mm": {"X": [5, 5]}}}, "machine.stroke_mm.X: the highest position must be above the lowest"),
        ({"machine": {"chain": "w-X-Y-Z-t"}}, "machine.chain: 'w-X-Y-Z-t' is not w-...-t with X, Y, Z and b once each"),
        ({"machine": {"chain": "w-X-X-b-Z-t"}}, "machine.chain: 'w-X-X-b-Z-t' is not w-...-t with X, Y, Z and b once each"),
        ({"laser": {"transport": "usb"}}, "laser.transport: 'usb' is none of tcp, rtu"),
        ({"cnc": {"port": 70000}}, "cnc.port: must be 0..65535"),
    ],
)
def test_bad_scenarios_are_named_in_one_line(data: dict[str, object], message: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        from_dict(data)
    assert str(caught.value) == message


def test_missing_and_broken_files(tmp_path) -> None:
    with pytest.raises(ScenarioError, match=r"none\.toml"):
        load(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("seed = ")
    with pytest.raises(ScenarioError, match=r"bad\.toml"):
        load(tmp_path / "bad.toml")


def test_all_24_chains() -> None:
    seen = set()
    for order in itertools.permutations("XYZb"):
        work, tool = parse_chain("-".join(["w", *order, "t"]))
        assert sorted(work + tool) == [0, 1, 2]
        seen.add((work, tool))
    assert len(seen) == 24
    assert parse_chain("w-X-Y-b-Z-t") == ((0, 1), (2,))
