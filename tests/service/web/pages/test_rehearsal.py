"""The new test's dry run: the command line's figures, from what the core tells; and the names that a rate gives a recipe."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import httpx
import pytest
from fastapi import FastAPI

from abbe.service.channel.messages import MachineSummary
from abbe.service.clock import SystemClock
from abbe.service.domain.machine import MachineObject, Rules, machine_from_doc
from abbe.service.errors import ConfigError
from abbe.service.sequences.check import dry_run_campaign
from abbe.service.sequences.recipes.campaigns import RATES_HZ, named, recipe_plan, split_recipe_name
from abbe.service.web.core_link.core_line import CoreLine
from abbe.service.web.jobs import add_jobs
from abbe.service.web.page import HERE, environment
from abbe.service.web.pages.new import expired_certificates
from abbe.service.web.pages.rehearsal import CAMPAIGN, Rehearsals
from abbe.service.web.schemas import LONGEST_RECIPE
from abbe.service.web.strip import strip_of
from tests.service.core.fakes import utc

STROKES = {"X": (0.0, 600.0), "Y": (0.0, 500.0), "Z": (0.0, 450.0)}
DOC = {"chain": "w-Y-X-b-Z-t", "vertical_axis": "Z", "stroke_mm": STROKES, "tool_mm": (0.0, 0.0, 150.0)}
TOLD = MachineSummary(MachineObject.read(DOC), 6000.0)
MACHINE = machine_from_doc(DOC)
PLANS = Rehearsals(TOLD, ("quick-check", "verification"))


@pytest.mark.parametrize("rate_hz", [100, 1000])
def test_it_says_what_the_command_line_says(rate_hz: int) -> None:
    dry = PLANS.run("quick-check", rate_hz)
    assert dry is not None
    runs = dry_run_campaign(MACHINE, recipe_plan(named("quick-check", rate_hz), MACHINE), 6000.0)
    assert dry.runs == runs
    assert dry.startable
    assert dry.duration_s == pytest.approx(sum(run.duration_s for run in runs))
    assert dry.readings == sum(run.readings for run in runs) > rate_hz * 60
    assert [(one.what, one.number) for one in dry.set_ups] == [("bar", 1), *(("laser", k) for k in range(2, 6))]
    assert dry.set_ups[0].radius_mm > 20.0
    for axis, low, high, least, most in dry.used:
        assert STROKES[axis] == (least, most)
        assert least <= low < high <= most
    assert dry.picture.startswith("<svg")


def test_what_cannot_be_run_says_why() -> None:
    slow = Rehearsals(replace(TOLD, max_feed_mm_min=500.0), ("quick-check",)).run("quick-check", 100)
    assert slow is not None
    assert not slow.startable
    assert "the limit is 500" in slow.trouble
    assert slow.runs == ()


@pytest.mark.parametrize("startable", [False, True])
def test_the_full_campaign_is_shown_and_started_where_the_core_says_so(startable: bool) -> None:
    plans = Rehearsals(TOLD, (*PLANS.recipes, CAMPAIGN, "own.toml") if startable else PLANS.recipes)
    assert plans.choices() == ("quick-check", "verification", CAMPAIGN)
    dry = plans.run(CAMPAIGN, 100)
    assert dry is not None
    assert (dry.startable, len(dry.runs), len(dry.set_ups)) == (startable, 21, 19)


def test_nothing_is_known_of_a_machine_that_nobody_described() -> None:
    assert Rehearsals(None, ("quick",)).run("quick", 100) is None
    assert PLANS.run("no-such", 100) is None
    assert Rehearsals(TOLD, ("own.toml",)).run("own.toml", 100) is None


def test_a_rate_is_part_of_the_name() -> None:
    assert [split_recipe_name(named("quick-check", rate)) for rate in RATES_HZ] == [("quick-check", rate) for rate in RATES_HZ]
    assert named("quick-check", 100) == "quick-check"
    for odd in ("quick-check at 300 Hz", "quick-check at 0 Hz", "quick-check at 10000 Hz", "quick-check at 1e3 Hz"):
        assert split_recipe_name(odd) == (odd, 100)
        with pytest.raises(ConfigError):
            recipe_plan(odd, MACHINE)


def test_the_screen_counts_the_set_ups() -> None:
    told = SimpleNamespace(job=None, next_due=[])
    known = {"bar": strip_of(None), "choices": PLANS.choices(), "chosen": "quick-check", "rates_hz": PLANS.rates_hz, "rate_hz": 100}
    known |= {
        "max_feed": 6000.0,
        "may_measure": True,
        "guided": False,
        "alarm": 0,
        "begins": None,
        "interrupted": None,
        "resumes": False,
        "key": "k",
        "expired": [],
        "temperature_c": None,
    }
    screen = environment().get_template("new.html")
    assert "<dd>5</dd>" in screen.render(machine="m", zone="UTC", status=told, dry=PLANS.run("quick-check", 100), **known)
    for name in ("new", "runs", "volume"):  # the filter `length` is ours here, and converts a number
        assert "s | length" not in (HERE / "templates" / f"{name}.html").read_text(encoding="utf-8")


def test_a_timetable_s_rate_makes_no_other_recipe() -> None:
    plans = Rehearsals(TOLD, ("quick-check", "verification at 500 Hz", "verification"))
    assert plans.choices() == ("quick-check", "verification", CAMPAIGN)
    dry = plans.run("verification", 1000)
    assert dry is not None
    assert (dry.trouble, dry.startable) == ("", True)


async def test_a_name_that_its_rate_makes_too_long_is_refused() -> None:
    assert len(named("r" * LONGEST_RECIPE, max(RATES_HZ))) <= 200
    app = FastAPI()
    add_jobs(app, CoreLine(None, SystemClock()), ())  # type: ignore[arg-type] - nothing gets so far as to ask the core
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://127.0.0.1") as client:
        answer = await client.post("/api/v1/jobs", json={"recipe": "r" * 195, "rate_hz": 1000})
    assert answer.status_code == 422


def test_certificates_that_are_over_are_told() -> None:
    today = utc(2026, 11, 22, 6).date()
    rules = Rules({}, {"ballbar": today.replace(year=2025), "laser": today}, None)
    assert expired_certificates(rules, today) == [("ballbar", today.replace(year=2025))]
    assert expired_certificates(None, today) == []
