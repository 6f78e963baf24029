"""Two screens: a new measurement (recipe, dry run, checklist, start; only the start moves the machine), and the running measurement."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable, Sequence
from datetime import date
from typing import Annotated

import numpy as np
from fastapi import FastAPI, Query
from fastapi.responses import HTMLResponse, JSONResponse

from abbe.service.domain.document import Doc
from abbe.service.domain.machine import Rules
from abbe.service.domain.people import Permission
from abbe.service.domain.progress import JobState
from abbe.service.errors import AbbeError
from abbe.service.jobs.interrupted import interrupted_campaign
from abbe.service.queries.alarms import path_of_alarm
from abbe.service.queries.checks import last_good, latest_checks
from abbe.service.queries.reader import Reader
from abbe.service.runs.columns import load_run
from abbe.service.sequences.recipes.campaigns import USUAL_HZ
from abbe.service.web import language
from abbe.service.web.frame import current
from abbe.service.web.login.access import needs
from abbe.service.web.pages.context import Number, PageContext, Text
from abbe.service.web.pages.rehearsal import CAMPAIGN, Rehearsals

Recipe = Annotated[str, Query(max_length=200)]
Rate = Annotated[int, Query(ge=1, le=1000)]


def add_new_page(app: FastAPI, context: PageContext, plans: Rehearsals) -> None:
    """Add the screen of a new measurement to the application. ``plans``: recipes that can be rehearsed.

    For an ``alarm`` the full campaign also looks for its cause. With ``resume`` it completes this campaign, if that is the last one and
    was interrupted.
    """

    @app.get("/new", include_in_schema=False)
    @needs(Permission.READ)
    async def new(recipe: Recipe = "", rate_hz: Rate = USUAL_HZ, alarm: Number = None, resume: Text = "") -> HTMLResponse:
        status = await context.source.status()
        rate_hz = rate_hz if rate_hz in plans.rates_hz else USUAL_HZ
        choices = plans.choices()
        chosen = recipe if recipe in choices else next(iter(choices), "")
        interrupted = (
            await context.read(interrupted_campaign, context.reader.store, context.reader.machine, chosen) if chosen == CAMPAIGN else None
        )
        resumes = interrupted is not None and interrupted.name == resume
        if interrupted is not None and resumes:
            rate_hz, alarm = interrupted.rate_hz, interrupted.alarm
        dry = await asyncio.to_thread(plans.run, chosen, rate_hz, current().drawn("mm"))
        alarm = (alarm or 0) if chosen == CAMPAIGN else 0
        way = await context.read(path_of_alarm, context.reader, alarm) if alarm else None
        return await context.show(
            "new.html",
            status=status,
            choices=choices,
            chosen=chosen,
            rates_hz=plans.rates_hz,
            rate_hz=rate_hz,
            dry=dry,
            guided=chosen == CAMPAIGN,
            interrupted=interrupted,
            resumes=resumes,
            alarm=alarm,
            begins=None if way is None else way.begins,
            max_feed=None if plans.machine is None else plans.machine.max_feed_mm_min,
            may_measure=current().may(Permission.MEASURE) and bool(current().csrf),
            may_propose=current().may(Permission.PROPOSE),
            key=secrets.token_hex(16),
            expired=expired_certificates(plans.rules, status.now_utc.date()),
            temperature_c=None if plans.rules is None else plans.rules.temperature_c,
        )


def expired_certificates(rules: Rules | None, today: date) -> list[tuple[str, date]]:
    """Instruments with an expired certificate, and its last valid day."""
    certificates = {} if rules is None or rules.calibrated_until is None else rules.calibrated_until
    return [(kind, until) for kind, until in sorted(certificates.items()) if until < today]


SCRIPT_KEYS = (
    "live.abort", "live.ended", "live.gone", "live.old", "live.pause", "live.resume", "live.stop", "live.no_path",
    "live.of", "live.share_here", "live.before", "live.laser", "live.laser.strip", "live.strip", "live.door.open", "live.door.shut",
)  # fmt: skip
"""Texts for the script, besides the states and outcomes of a measurement."""


def add_live_page(app: FastAPI, context: PageContext, jobs: Callable[[], Sequence[JobState]] = tuple) -> None:
    """Add the screen of the running measurement and of the last outcome. ``jobs``: jobs since the service started, newest first."""

    @app.get("/live", include_in_schema=False)
    @needs(Permission.READ)
    async def live() -> HTMLResponse:
        status = await context.source.status()
        return await context.show(
            "live.html",
            status=status,
            last=next((job for job in jobs() if job.ended_utc is not None), None),
            may_measure=current().may(Permission.MEASURE) and bool(current().csrf),
            texts=script_texts(current().lang),
            due_words=lambda one: language.due(current().lang, one.due_utc, status.now_utc),
        )

    @app.get("/live/before", include_in_schema=False)
    @needs(Permission.READ)
    async def before(run: Text = "") -> JSONResponse:
        status = await context.source.status()
        if status.job is None or not run:
            return JSONResponse(NO_SHAPE)
        return JSONResponse(await context.read(last_good_shape, context.reader, status.job.recipe, run))


def script_texts(lang: str) -> dict[str, str]:
    """The texts for the script, by key."""
    texts = language.catalogue(lang)
    states = {key: text for key, text in texts.items() if key.startswith(("measuring.", "slot."))}
    return {key: texts[key] for key in SCRIPT_KEYS} | states


LOOK_BACK = 200
"""Number of earlier checks among which the last good one is searched."""
PARTS = 720
NO_SHAPE: Doc = {"check": None, "values": []}


def last_good_shape(reader: Reader, recipe: str, label: str) -> Doc:
    """Mean deviation, µm, in each of at most `PARTS` equal parts of a run of the last good check; empty without such a check."""
    good = last_good(latest_checks(reader, LOOK_BACK), recipe)
    if good is None or not good.campaign or label not in good.runs:
        return NO_SHAPE
    try:
        campaign = reader.store.campaigns.find(good.campaign)
        run = next((r for r in reader.store.runs.all(campaign.id) if r.label == label and r.visible_status == "complete"), None)
        columns = None if run is None else load_run(reader.store, run.id).columns
    except AbbeError:
        return NO_SHAPE
    if columns is None or columns.deviation_mm is None or not columns.t_s.size:
        return NO_SHAPE
    t_s, deviation_um = columns.t_s, 1e3 * columns.deviation_mm
    good_ones = columns.valid & np.isfinite(deviation_um)
    parts = min(PARTS, -(-t_s.size // 2))
    share = (t_s - t_s[0]) / max(float(t_s[-1] - t_s[0]), 1e-9)
    part = np.minimum((share * parts).astype(int), parts - 1)[good_ones]
    count = np.bincount(part, minlength=parts)
    total = np.bincount(part, deviation_um[good_ones], minlength=parts)
    return {"check": good.id, "values": [float(f"{v / n:.4g}") if n else None for v, n in zip(total, count, strict=True)]}
