"""One value of a TOML text changes; everything else stays byte for byte, and what cannot be done so is refused."""

from __future__ import annotations

import tomllib
from datetime import date
from pathlib import Path

import pytest

from abbe.service.config_schema import MachineFile
from abbe.service.toml_text import NotEditableError, edited, key_lines

EXAMPLE = (Path(__file__).parents[2] / "deploy" / "machine.example.toml").read_text(encoding="utf-8")
TEXT = """# head
name = "mill # 7"   # a name

[limits]
# agreed on 3 May
table_value_um = 100.0   # of the maker
temperature_c = [
  18.0, # low
  24.0,
]

[verify] # of the check
helix_rms_um = 5.0

# nights
[[schedule]]
name = "night"
cron = "0 2 * * *"
needs = { idle = true, warm_min = 20.0 }

[[schedule]]
name = "week"
every_h = 168.0
[schedule.needs]
idle = true
# the end
"""


def lines_changed(text: str, key: str, value: object) -> tuple[list[str], list[str]]:
    """What is gone and what is new."""
    before, after = text.split("\n"), edited(text, key, value).split("\n")
    return [one for one in before if one not in after], [one for one in after if one not in before]


@pytest.mark.parametrize(
    ("key", "value", "gone", "new"),
    [
        ("limits.table_value_um", 80.0, ["table_value_um = 100.0   # of the maker"], ["table_value_um = 80.0  # of the maker"]),
        ("limits.two_people", True, [], ["two_people = true"]),
        (
            "limits.temperature_c",
            [19, 21.5],
            ["temperature_c = [", "  18.0, # low", "  24.0,", "]"],
            ["# low", "temperature_c = [19, 21.5]"],
        ),
        ("name", 'a "b"', ['name = "mill # 7"   # a name'], ['name = "a \\"b\\""  # a name']),
        ("vertical_axis", "Z", [], ['vertical_axis = "Z"']),
        ("calibration.ballbar", date(2027, 5, 31), [], ["[calibration]", "ballbar = 2027-05-31"]),
        ("item.serial", "2027-05-31", [], ["[item]", 'serial = "2027-05-31"']),
        ("schedule[1].needs.warm_min", 5, ["needs = { idle = true, warm_min = 20.0 }"], ["needs = {idle = true, warm_min = 5}"]),
        ("schedule[2].needs.warm_min", 5, [], ["warm_min = 5"]),
        ("schedule[2].cron", "0 1 * * *", [], ['cron = "0 1 * * *"']),
        ("schedule[1].needs.idle", None, ["needs = { idle = true, warm_min = 20.0 }"], ["needs = {warm_min = 20.0}"]),
        ("verify.helix_rms_um", None, ["helix_rms_um = 5.0"], []),
        ("verify", None, ["[verify] # of the check", "helix_rms_um = 5.0"], []),
        ("schedule[2].needs", None, ["[schedule.needs]", "idle = true"], []),
    ],
)
def test_one_value_changes_and_the_rest_stays(key: str, value: object, gone: list[str], new: list[str]) -> None:
    assert lines_changed(TEXT, key, value) == (gone, new)


def test_a_table_of_a_list_is_added_and_removed() -> None:
    more = edited(edited(TEXT, "schedule[3].name", "month"), "schedule[3].needs.air", value=True)
    assert [one["name"] for one in tomllib.loads(more)["schedule"]] == ["night", "week", "month"]
    assert tomllib.loads(more)["schedule"][2]["needs"] == {"air": True}
    less = edited(edited(TEXT, "schedule[1]", None), "schedule[1]", None)
    assert "schedule" not in tomllib.loads(less)
    assert [one for one in TEXT.split("\n") if one.startswith("#")] == [one for one in less.split("\n") if one.startswith("#")]


def test_every_value_of_the_example_can_be_written_and_stays_the_same() -> None:
    """Each key is replaced by its own value: the file says the same."""
    values = tomllib.loads(EXAMPLE)
    for key in key_lines(EXAMPLE):
        value: object = values
        for part in key.replace("[", ".[").split("."):
            value = value[int(part[1:-1]) - 1] if part.startswith("[") else value[part]  # type: ignore[index]
        assert tomllib.loads(edited(EXAMPLE, key, value)) == values


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("limits.table_value_um = 5\n", "limits.table_step_um"),  # a table by dotted keys takes no header
        ("a = 1\n", "a.b"),
        ("a = [1]\n", "a[3].b"),
    ],
)
def test_what_cannot_be_changed_alone_is_refused(text: str, key: str) -> None:
    with pytest.raises(NotEditableError, match="cannot be changed"):
        edited(text, key, 1)


def test_a_text_cannot_leave_its_value() -> None:
    evil = 'x"\n[web]\nhost = "0.0.0.0" # \x7f\\ 雪'
    assert tomllib.loads(edited(TEXT, "name", evil)) == tomllib.loads(TEXT) | {"name": evil}


def test_only_keys_of_the_schema_are_dotted() -> None:
    assert not [key for key in MachineFile.model_fields if "." in key or "[" in key]
