"""Changes of the machine file: the parser of the file judges them, and what allows more than before is called so."""

from __future__ import annotations

from dataclasses import fields as dataclass_fields
from pathlib import Path

import pytest

from abbe.service.config import LoadedMachine, parse_machine
from abbe.service.config_schema import Calibration, Limits, Verify
from abbe.service.domain.machine_file import FileEdit
from abbe.service.domain.people import ALLOWED, Permission, Role
from abbe.service.domain.schedule import Needs, Schedule
from abbe.service.errors import ConfigError
from abbe.service.machine_changes import LOOSER, RIGHTS, changed, differences, is_looser

PATH = Path("machine.toml")
TEXT = """name = "mill"
chain = "w-X-Y-b-Z-t"
[stroke_mm]
X = [0, 600]
Y = [0, 500]
Z = [0, 450]
[limits]
table_value_um = 80.0  # of the maker
[calibration]
laser = 2027-01-31
"""
SCHEDULE = """[[schedule]]
name = "{}"
cron = "{}"
"""
IDENTITIES = {f"calibration.{kind}_is" for kind in ("ballbar", "laser", "artefact")}


@pytest.fixture
def loaded() -> LoadedMachine:
    return parse_machine(PATH, TEXT.encode())


def test_a_change_is_parsed_as_the_file_is_and_told_with_both_values(loaded: LoadedMachine) -> None:
    new = changed(loaded, (FileEdit("limits.table_value_um", "90"), FileEdit("calibration.laser", '"2026-12-31"')))
    assert new.body.decode() == TEXT.replace("80.0", "90").replace("2027-01-31", "2026-12-31")
    assert (new.machine.limits.table_value_um, new.machine.calibration.until()["laser"].isoformat()) == (90.0, "2026-12-31")
    told = [(str(one), one.looser) for one in differences(loaded, new)]
    assert told == [("limits.table_value_um 80.0 → 90.0", True), ("calibration.laser 2027-01-31 → 2026-12-31", False)]
    back = changed(new, (FileEdit("limits.table_value_um", "null"),))
    assert [str(one) for one in differences(new, back)] == ["limits.table_value_um 90.0 → 100.0"], "the default, which is looser"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("limits.table_value_um", "-1"),
        ("limits.table_value_um", '"80"'),
        ("limits.table_values_um", "80"),
        ("issuer.city", '"Ulm"'),
        ("calibration.laser", '"soon"'),
        ("limits.table_value_um", "{"),
        ("limits", "5"),
        ("schedule[3].name", '"late"'),
        ("schedule[1].name", '"without times"'),
        ("calibration.laser", '"2027-02-30"'),
        ("calibration.laser", '"2027-2-3"'),
        ("item.serial", "[" * 3900),
        ("item.serial", "[" * 400 + "]" * 400),
        ("item.serial", '{"a":' * 900 + "1" + "}" * 900),
        ("item.serial", '"\\ud83d"'),
        ("calibration.laser", '"\\ud83d"'),
    ],
)
def test_what_the_parser_refuses_is_no_change(loaded: LoadedMachine, key: str, value: str) -> None:
    with pytest.raises(ConfigError):
        changed(loaded, (FileEdit(key, value),))


def test_an_impossible_day_is_told_clearly_and_a_serial_number_that_looks_like_a_day_is_text(loaded: LoadedMachine) -> None:
    with pytest.raises(ConfigError, match=r"^calibration\.laser: expected a day such as 2027-05-31, got '2027-02-30'"):
        changed(loaded, (FileEdit("calibration.laser", '"2027-02-30"'),))
    new = changed(loaded, (FileEdit("item.serial", '"2027-05-31"'),))
    assert new.machine.item.serial == "2027-05-31"
    assert new.body.decode().endswith('[item]\nserial = "2027-05-31"\n')


def test_what_the_environment_sets_is_not_changed_in_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ABBE_LIMITS__TABLE_VALUE_UM", "70")
    with pytest.raises(ConfigError, match="environment"):
        changed(parse_machine(PATH, TEXT.encode()), (FileEdit("limits.table_value_um", "60"),))


def test_line_ends_stay_those_of_the_file() -> None:
    body = TEXT.replace("\n", "\r\n").encode()
    new = changed(parse_machine(PATH, body), (FileEdit("limits.table_value_um", "90"),))
    assert new.body == body.replace(b"80.0", b"90")


def test_schedules_are_told_by_their_names(loaded: LoadedMachine) -> None:
    two = changed(loaded, tuple(FileEdit(f"schedule[{n}].{key}", value) for n, name in ((1, '"a"'), (2, '"b"')) for key, value in
                                (("name", name), ("cron", '"0 6 * * 1"'))))  # fmt: skip
    one = changed(two, (FileEdit("schedule[1]", "null"),))
    assert [entry.name for entry in one.machine.schedule] == ["b"]
    assert {str(change).partition(".")[0] for change in differences(two, one)} == {"schedule[a]"}


def test_a_schedule_whose_name_is_a_number_hides_no_other() -> None:
    one = parse_machine(PATH, f"{TEXT}{SCHEDULE.format('2', '0 6 * * 1')}{SCHEDULE.format('b', '0 7 * * 1')}".encode())
    two = parse_machine(PATH, f"{TEXT}{SCHEDULE.format('2', '* * * * *')}{SCHEDULE.format('b', '0 7 * * 1')}".encode())
    assert [str(change) for change in differences(one, two)] == ["schedule[2].cron 0 6 * * 1 → * * * * *"]


def test_a_section_in_which_only_a_secret_differs_is_named_without_it() -> None:
    one, two = (parse_machine(PATH, f'{TEXT}[mqtt]\nurl = "mqtt://u:{word}@broker:1883"\n'.encode()) for word in ("old", "new"))
    assert [(change.key, str(change)) for change in differences(one, two)] == [("mqtt", "mqtt – → –")]


def test_a_new_schedule_is_looser_by_its_name_and_a_removed_one_in_nothing(loaded: LoadedMachine) -> None:
    new = parse_machine(PATH, f"{TEXT}{SCHEDULE.format('night', '0 2 * * *')}".encode())
    assert [str(change) for change in differences(loaded, new) if change.looser] == ["schedule[night].name – → night"]
    assert [change for change in differences(new, loaded) if change.looser] == []


@pytest.mark.parametrize(
    ("key", "tight", "loose"),
    [
        ("limits.table_value_um", 80.0, 81.0),
        ("limits.two_people", True, False),
        ("limits.settle_s", 10.0, 9.0),
        ("verify.reversal_um", 5.0, 6.0),
        ("verify.reversal_um", 5.0, None),
        ("limits.temperature_c", [19.0, 21.0], [19.0, 21.5]),
        ("limits.temperature_c", [19.0, 21.0], [18.0, 20.0]),
        ("limits.run_temperature_c", [19.0, 21.0], None),
        ("limits.continue_after", ["door"], ["door", "beam"]),
        ("calibration.laser", "2027-01-31", "2027-02-01"),
        ("calibration.laser", None, "2027-02-01"),
        ("calibration.room_temperature_c", None, [20.0, 21.0]),
        ("schedule[a.b].needs.idle", True, False),
        ("schedule[night].needs.warm_min", 30.0, 0.0),
        ("schedule[night].needs.air", True, False),
        ("schedule[night].needs.operator", "absent", "any"),
        ("schedule[night].on_alarm", "none", "propose"),
        ("schedule[night].catch_up", "skip", "once"),
        ("schedule[night].grace_s", 300.0, 600.0),
    ],
)
def test_what_allows_more_is_looser_and_its_contrary_is_not(key: str, tight: object, loose: object) -> None:
    assert is_looser(key, tight, loose)
    assert not is_looser(key, tight, tight)
    if key != "limits.temperature_c" or loose == [19.0, 21.5]:
        assert not is_looser(key, loose, tight)


@pytest.mark.parametrize(
    ("key", "one", "other"),
    [
        ("cron", "0 6 * * 1", "0 7 * * 1"),
        ("timezone", "UTC", "Europe/Berlin"),
        ("every_h", 24.0, 12.0),
        ("first", "2026-01-01T00:00:00Z", "2026-01-01T01:00:00Z"),
        ("recipe", "quick-check", "full-check"),
    ],
)
def test_another_time_or_recipe_of_a_schedule_is_looser_both_ways(key: str, one: object, other: object) -> None:
    assert is_looser(f"schedule[night].{key}", one, other)
    assert is_looser(f"schedule[night].{key}", other, one)
    assert not is_looser(f"schedule[night].{key}", one, one)


def test_every_limit_certificate_and_value_of_a_schedule_has_a_rule() -> None:
    """A new one cannot be forgotten."""
    sections = {"limits": Limits, "verify": Verify, "calibration": Calibration}
    keys = {f"{name}.{key}" for name, model in sections.items() for key in model.model_fields}
    keys |= {f"schedule.{one.name}" for one in dataclass_fields(Schedule) if one.name != "needs"}
    keys |= {f"schedule.needs.{one.name}" for one in dataclass_fields(Needs)}
    assert set(LOOSER) == keys - IDENTITIES


def test_limits_need_the_right_to_approve_and_nobody_has_both_rights() -> None:
    assert {section for section, need in RIGHTS.items() if need is Permission.APPROVE} == {"limits", "verify", "calibration"}
    for role in Role:
        assert not {Permission.APPROVE, Permission.CONFIGURE} <= ALLOWED[role], role
    assert set(RIGHTS) & {"web", "store", "devices", "signatures", "mqtt", "opcua", "alarm"} == set()
