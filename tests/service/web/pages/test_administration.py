"""Forms that change the machine file: they have every value of their sections, ask for what differs alone, and say why not."""

from __future__ import annotations

import re
from typing import Any

import pytest

from abbe.service.config import parse_machine
from abbe.service.config_schema import MachineFile
from abbe.service.domain.machine_file import MachineFileSummary
from abbe.service.domain.schedule import Needs, Schedule
from abbe.service.machine_changes import RIGHTS, changed, section_of
from abbe.service.rendering.phrases import LANGUAGES, is_whole
from abbe.service.web.language import catalogue
from abbe.service.web.login.access import route_permissions
from abbe.service.web.pages import administration
from abbe.service.web.pages import file_fields as fields
from abbe.service.web.pages.file_fields import FormError, edits_of, schedule_fields, shown_fields
from tests.pages_world import USERS, Served, as_user
from tests.service.test_machine_changes import PATH, TEXT
from tests.service.web.test_table_orders import Desk, desk

__all__ = ["desk"]  # the fixture
FORMS = {"laboratory": "issuer", "limits": "limits", "certificates": "calibration", "schedule": "schedule"}
WHOLE = (
    TEXT
    + """
[issuer]
laboratory = "Gauge room"
city = "Bonn"
country = "DE"
person = "A. Probst"
[[schedule]]
name = "weekly"
cron = "0 6 * * 1"
timezone = "Europe/Berlin"
"""
)
EVERY = (*fields.LABORATORY, *fields.LIMITS, *fields.CERTIFICATES)


def stated(text: str = WHOLE) -> MachineFileSummary:
    return parse_machine(PATH, text.encode()).summary()


def sent(some: Any, known: MachineFileSummary) -> dict[str, str]:
    """What a browser sends of untouched fields."""
    form: dict[str, str] = {}
    for one in shown_fields(some, known):
        if one.field.kind == "range":
            form |= {f"{one.field.key}.{end}": text for end, text in zip(fields.ENDS, one.texts, strict=True)}
        elif one.field.kind == "many":
            form |= {one.field.key: "shown", **{f"{one.field.key}.{text}": "yes" for text in one.texts if text}}
        elif one.field.kind == "times":
            form |= {f"{one.field.key}.days": one.texts[0], f"{one.field.key}.time": one.texts[1], one.field.key: one.texts[2]}
        else:
            form[one.field.key] = one.texts[0]
    return form


def asked(some: Any, **changes: str) -> dict[str, str]:
    known = stated()
    form = sent(some, known) | {key.replace("__", "."): value for key, value in changes.items()}
    return {edit.key: edit.value for edit in edits_of(some, form, known)}


def test_the_forms_have_every_value_of_their_sections() -> None:
    models = {name: MachineFile.model_fields[name].annotation for name in RIGHTS if name not in {"issuer", "schedule"}}
    keys = {f"{name}.{key}" for name, model in models.items() for key in model.model_fields}  # type: ignore[union-attr]
    keys |= {one.key for one in stated().values if one.key.startswith("issuer.")}
    assert {one.key for one in EVERY} == keys
    names = {*Schedule.__dataclass_fields__, *(f"needs.{key}" for key in Needs.__dataclass_fields__)} - {"needs"}
    assert {one.key for one in fields.SCHEDULE} == names
    labels = {one.label for one in shown_fields((*EVERY, *schedule_fields(1, ())), stated())}
    for lang in LANGUAGES:
        assert {f"file.{label}" for label in labels} <= set(catalogue(lang)), lang


def test_untouched_forms_ask_for_nothing() -> None:
    for text in (WHOLE, TEXT):
        known = stated(text)
        for some in (
            fields.LABORATORY,
            fields.LIMITS,
            fields.CERTIFICATES,
            *((schedule_fields(1, ("quick-check",)),) if text == WHOLE else ()),
        ):
            assert edits_of(some, sent(some, known), known) == ()
            assert edits_of(some, {}, known) == ()


@pytest.mark.parametrize(
    ("some", "changes", "expected"),
    [
        (fields.LIMITS, {"verify__helix_rms_um": "6,5"}, {"verify.helix_rms_um": "6.5"}),
        (fields.LIMITS, {"verify__helix_rms_um": "much"}, {"verify.helix_rms_um": '"much"'}),
        (fields.LIMITS, {"limits__table_value_um": ""}, {"limits.table_value_um": "null"}),
        (fields.LIMITS, {"limits__two_people": "yes"}, {"limits.two_people": "true"}),
        (fields.LIMITS, {"limits__temperature_c__low": "19"}, {"limits.temperature_c": "[19, 24]"}),
        (fields.LIMITS, {"limits__run_temperature_c__low": "19"}, {"limits.run_temperature_c": "[19, null]"}),
        (fields.LIMITS, {"limits__continue_after__door": "yes"}, {"limits.continue_after": '["door"]'}),
        (fields.CERTIFICATES, {"calibration__laser": ""}, {"calibration.laser": "null"}),
        (fields.CERTIFICATES, {"calibration__ballbar": "2027-05-31"}, {"calibration.ballbar": '"2027-05-31"'}),
        (fields.LABORATORY, {"issuer__customer": " Werk 2 "}, {"issuer.customer": '"Werk 2"'}),
        (
            fields.LABORATORY,
            dict.fromkeys(("issuer__laboratory", "issuer__city", "issuer__country", "issuer__person"), ""),
            {"issuer": "null"},
        ),
        (
            schedule_fields(1, ()),
            {"schedule[1]__every_h": "24", "schedule[1]__cron__days": "interval", "schedule[1]__cron__time": ""},
            {"schedule[1].cron": "null", "schedule[1].every_h": "24"},
        ),
        (schedule_fields(1, ()), {"schedule[1]__cron__days": "workdays"}, {"schedule[1].cron": '"0 6 * * 1-5"'}),
        (schedule_fields(1, ()), {"schedule[1]__cron__time": "00:05"}, {"schedule[1].cron": '"5 0 * * 1"'}),
        (
            schedule_fields(1, ()),
            {"schedule[1]__cron__days": "expression", "schedule[1]__cron__time": "", "schedule[1]__cron": "0 6 1 * *"},
            {"schedule[1].cron": '"0 6 1 * *"'},
        ),
    ],
)
def test_a_form_asks_for_what_differs(some: Any, changes: dict[str, str], expected: dict[str, str]) -> None:
    assert asked(some, **changes) == expected


@pytest.mark.parametrize(
    "changes",
    [
        {"cron": "0 2 1 * *"},
        {"every_h": "24"},
        {"cron.time": ""},
        {"cron.time": "6"},
        {"cron.days": ""},
        {"cron.days": "expression"},
        {"cron.days": "expression", "cron": "0 2 1 * *"},
        {"cron.days": "expression", "cron.time": ""},
        {"cron.days": "interval", "cron.time": ""},
        {"cron.days": "interval", "every_h": "24"},
        {"cron.days": "often"},
    ],
)
def test_times_that_a_form_states_twice_or_not_at_all_are_refused(changes: dict[str, str]) -> None:
    with pytest.raises(FormError, match=r"admin\.times"):
        asked(schedule_fields(1, ()), **{f"schedule[1].{key}": value for key, value in changes.items()})


@pytest.mark.parametrize("times", ['cron = "00 06 * * 1"', 'cron = "0 6 1 * *"', "every_h = 8.0", 'cron = "59 23 * * 0"'])
def test_an_untouched_schedule_keeps_its_times(times: str) -> None:
    known = stated(WHOLE.replace('cron = "0 6 * * 1"', times))
    assert edits_of(schedule_fields(1, ()), sent(schedule_fields(1, ()), known), known) == ()


def test_a_new_schedule_and_a_first_laboratory_are_valid_files() -> None:
    known, plan = stated(TEXT), schedule_fields(1, ("quick-check",))
    form = sent(plan, known) | {"schedule[1].name": "night", "schedule[1].cron.days": "daily", "schedule[1].cron.time": "02:00"}
    loaded = parse_machine(PATH, TEXT.encode())
    entry = changed(loaded, edits_of(plan, form, known)).machine.schedule[0]
    assert entry == Schedule("night", "0 2 * * *")
    form = sent(fields.LABORATORY, known) | {"issuer.laboratory": "L", "issuer.city": "C", "issuer.country": "FR", "issuer.person": "P"}
    issuer = changed(loaded, edits_of(fields.LABORATORY, form, known)).machine.issuer
    assert issuer is not None
    assert (issuer.laboratory, issuer.place) == ("L", "customer")


async def test_every_form_has_the_right_of_its_section(desk: Desk) -> None:
    needs = {path: need for method, path, need in route_permissions(desk.app.routes) if path.startswith("/administration/")}
    assert {path.rpartition("/")[2]: need for path, need in needs.items() if not path.endswith("/read")} == {
        form: RIGHTS[section] for form, section in FORMS.items()
    }
    assert {section_of(one.key) for one in fields.LABORATORY} == {"issuer", "item"}
    assert {section_of(one.key) for one in fields.LIMITS} == {"limits", "verify"}
    assert {section_of(one.key) for one in fields.CERTIFICATES} == {"calibration"}


@pytest.mark.parametrize("name", USERS)
def test_everybody_sees_the_values_and_only_the_right_role_a_button(running: Served, name: str) -> None:
    with as_user(running, name) as client:
        page = client.get("/administration").text
        open_forms = set(re.findall(r'action="/administration/(\w+)"(?:(?!</form>).)*?<fieldset class="bare">', page.replace("\n", " ")))
        shut = page.count('<fieldset class="bare" disabled>')
        assert 'value="Gauge room"' in page
        expected = {"admin": {"laboratory", "schedule", "read"}, "approver": {"limits", "certificates"}}.get(USERS[name], set())
        assert ('type="password"' in page) == bool(expected)
        assert (open_forms, shut > 0) == (expected, True)
        for form in ("laboratory", "limits", "certificates", "schedule", "read"):
            status = client.post(f"/administration/{form}", data={"password": "x"}).status_code
            assert status == (422 if form in expected else 403), form


def test_a_file_that_may_not_be_written_is_said_and_offers_nothing(running: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(administration, "may_replace", lambda _: False)
    for name, path in (("adam", "/machine.toml"), ("vera", "may not write machine.toml")):
        with as_user(running, name) as client:
            page = client.get("/administration").text
        assert ("may not write" in page, path in page, 'type="password"' in page) == (True, True, False)


def test_until_the_service_has_the_changed_file_its_values_are_not_called_changed(running: Served) -> None:
    with as_user(running, "adam") as client:
        now = re.findall(r'name="sha256" value="(\w+)"', client.get("/administration").text)[0]
        waits, done = client.get(f"/administration?was={now}"), client.get(f"/administration?was={'0' * 64}")
    assert ("starting anew" in waits.text, "has started anew" in waits.text, waits.headers["refresh"]) == (True, False, "2")
    assert 'type="password"' not in waits.text
    assert ("starting anew" in done.text, "has started anew" in done.text, "refresh" in done.headers) == (False, True, False)


REFUSALS = (
    "this allows more than before: verify.helix_rms_um 5.0 → 6.5. Tick that you mean it, and give the reason",
    "the machine file has changed since the service read it: read the file again, then look at the values",
    "nothing is different from the file in force",
    "a push is not finished: the limits stay as they are until it is",
    "this service was started without a machine file",
    "verify.helix_rms_um: expected greater than 0, got -3",
    "the machine is in use: machine file",
    "alarm.push is different in the file: start the service again on its computer to use the new value",
    "limits.two_people can be switched off only in the file, by somebody who may start the service",
    "calibration.laser: expected a day such as 2027-05-31, got '2027-02-30'",
)


@pytest.mark.parametrize("text", REFUSALS)
@pytest.mark.parametrize("lang", LANGUAGES[1:])
def test_a_refusal_is_told_in_the_readers_language(lang: str, text: str) -> None:
    keys = re.compile(r"verify\.helix_rms_um")
    assert is_whole(lang, keys.sub("5", text).replace("machine file", "quick-check") if "in use" in text else keys.sub("5", text))
