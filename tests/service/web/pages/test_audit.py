"""The audit's screen says in words what a person did; what the program recorded stands below it."""

from __future__ import annotations

import re
from typing import Any

import pytest
from fastapi import FastAPI

from abbe.service.cli.administration.audit import CHANGES, RECORDS_ITSELF
from abbe.service.core.file_changes import ACTION
from abbe.service.core.orders import CAMPAIGN, PUSH, ROLLBACK
from abbe.service.domain.service_records import AuditEvent
from abbe.service.rendering.phrases import LANGUAGES
from abbe.service.web import language
from abbe.service.web.api.tables import add_table_orders
from abbe.service.web.jobs import add_jobs
from abbe.service.web.pages.audit import DEEDS, deed
from abbe.service.web.pages.plant_screens import BUNDLE_ACTION
from tests.pages_world import Served, as_user
from tests.service.web.api_bench import Plant


def changing(app: FastAPI) -> set[str]:
    """Requests of an application that the audit records."""
    return {f"{method} {one.path}" for one in app.routes for method in getattr(one, "methods", None) or () if method not in {"GET", "HEAD"}}


def test_everything_that_is_recorded_has_words_in_every_language(plant: Plant) -> None:
    core: Any = None  # the routes are only listed
    orders = FastAPI()
    add_jobs(orders, core, (), ())
    add_table_orders(orders, core)
    actions = changing(plant.app) | changing(orders)
    actions |= {f"abbe {command}" for command in (*CHANGES, *RECORDS_ITSELF)} | {CAMPAIGN, PUSH, ROLLBACK, BUNDLE_ACTION, ACTION}
    told = [action for some in DEEDS.values() for action in some]
    assert len(actions) > 55
    assert actions == set(told)
    assert len(told) == len(set(told)), "every action has one deed"
    for lang in LANGUAGES:
        words = {key.removeprefix("deed.") for key in language.catalogue(lang) if key.startswith("deed.")}
        assert words == set(DEEDS), lang


@pytest.mark.parametrize(
    ("who", "target", "outcome", "expected"),
    [
        ("user:anna", "proposal 3", "done 303", ("anna", "proposal 3", "done", "ok")),
        ("token:anna/l4", "job 01ab, recipe verify", "refused 409", ("anna, by the program l4", "recipe verify", "refused", "bad")),
        ("os:root@box", "machine.toml", "TBL-001", ("root, command line of box", "machine.toml", "not done (TBL-001)", "bad")),
        ("anonymous", "/login", "failed: ValueError", ("nobody logged in", "", "failed", "bad")),
        ("user:ada", "user olga: add operator", "done 303", ("ada", "olga: operator", "done", "ok")),
        ("user:ada", "user olga: disable", "done 303", ("ada", "olga", "done", "ok")),
        ("os:abbe@box", "mill-7, alarm 2", "discovered", ("abbe, command line of box", "mill-7, alarm 2", "cause searched", "open")),
        ("somebody", "job 0123456789ab", "odd", ("somebody", "", "odd", "open")),
    ],
)  # fmt: skip
def test_a_record_is_told(who: str, target: str, outcome: str, expected: tuple[str, ...]) -> None:
    one = deed(AuditEvent(who=who, action="POST /proposal/approve", target=target, outcome=outcome))
    assert (one.who, one.target, one.end, one.sign) == expected
    assert one.what == "signed and approved a proposal"
    assert deed(AuditEvent(who=who, action="PUT /odd", target=target, outcome=outcome)).what == "PUT /odd"


def test_the_screen_has_words_above_and_the_record_in_a_fold(running: Served) -> None:
    running.auth.book.write(AuditEvent(who="user:anna", action="POST /proposal/approve", target="proposal 3", outcome="done 303"))
    for lang, words in (("en", "signed and approved a proposal"), ("ja", "補正案に署名して承認")):
        with as_user(running, "anna", **{"Accept-Language": lang}) as client:
            above, _, fold = client.get("/audit").text.partition("<details>\n  <summary>")
        assert words in above
        assert "POST /" not in above
        number = running.store.audit.events(1)[0].id
        assert re.search(rf'<li value="{number}">user:anna · POST /proposal/approve · proposal 3 · done 303</li>', fold)


@pytest.mark.parametrize(
    ("action", "target", "expected"),
    [
        ("abbe check-config", "/etc/abbe/machine.toml", "machine.toml"),
        ("POST /login", "/login", ""),
        (ACTION, "verify.helix_rms_um 5.0 → 6.5, schedule[night].cron – → 0 2 * * *",
         "Helix rms, µm 5.0 → 6.5, Times (night) – → 0 2 * * *"),
    ],
)  # fmt: skip
def test_a_command_names_its_file_and_a_change_its_values(action: str, target: str, expected: str) -> None:
    assert deed(AuditEvent(who="os:root@box", action=action, target=target, outcome="done")).target == expected
