"""Routes: solutions, discoveries, trends."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

from fastapi import FastAPI, Query
from pydantic import BeforeValidator

from abbe.service.discovery.changed_words import proved
from abbe.service.discovery.discovery_states import taken_back
from abbe.service.errors import Unusable
from abbe.service.runs.discovery_file import DiscoveryFile
from abbe.service.runs.solution_file import SolutionFile
from abbe.service.users.roles import Permission
from abbe.service.verification.trend_table import as_doc, trends
from abbe.service.verification.verified_by import verified_by
from abbe.service.web.api.shapes import Trends
from abbe.service.web.api.shapes_tables import (
    ChangedSince,
    Discoveries,
    Discovery,
    DiscoveryDetail,
    DiscoveryState,
    Solution,
    SolutionDetail,
    Solutions,
)
from abbe.service.web.api.sources import Cursor, Doc, Filter, Limit, Number, Sources, read_as, storable
from abbe.service.web.login.access import needs

CHECKS = 20_000
"""So many of the latest checks make a trend: more than ten years of four a day."""


def _no_number(value: object) -> object:
    """A count of seconds is no moment that a person can check."""
    try:
        float(str(value))
    except ValueError:
        return value
    raise ValueError("expected a date and time, e.g. 2026-11-21T03:00:00Z")


UtcTime = Annotated[datetime, BeforeValidator(_no_number)]


def add_found(app: FastAPI, sources: Sources) -> None:
    """Add the routes."""
    _add_solutions(app, sources)
    _add_discoveries(app, sources)

    @app.get("/api/v1/trends")
    @needs(Permission.READ)
    def trend(
        machine: Annotated[str | None, Query(description="Absent: the machine of this service.")] = None,
        after: Annotated[
            UtcTime | None, Query(description="Only later checks (UTC if it does not say); absent: since the table came.")
        ] = None,
    ) -> Trends:
        """Do the figures of the checks drift, since when, and when do they reach their limits."""
        name = sources.machine if machine is None else machine
        since = after.replace(tzinfo=UTC) if after is not None and after.tzinfo is None else after
        if not storable(name):
            return Trends.model_validate(as_doc(name, []) | {"machine": name})
        known, records = (
            verified_by(sources.store, name, control=sources.control_of(name)),
            sources.store.verifications_of(name, limit=CHECKS),
        )
        found = as_doc(name, trends(records, known.since if since is None else since))
        return Trends.model_validate(found | {"machine": name, "verified": known.as_doc() | {"changes": known.changes}})


def _add_solutions(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/solutions")
    @needs(Permission.READ)
    def solutions(campaign: Filter = None, machine: Filter = None, cursor: Cursor = None, limit: Limit = 50) -> Solutions:
        """Solutions, newest first."""
        rows, after = sources.page("solutions", {"campaign": campaign, "machine": machine}, cursor, limit)
        return Solutions(solutions=[Solution(number=row["id"], runs=row["run_ids"], **row) for row in rows], next_cursor=after)

    @app.get("/api/v1/solutions/{number}")
    @needs(Permission.READ)
    def solution(number: Number) -> SolutionDetail:
        """A solution: parameters with uncertainties, what was not observable, residuals, budget."""
        row = sources.row("solutions", number, "solution")
        document = read_as(SolutionFile, row["doc"])
        if document is None:
            raise Unusable(f"solution {number} was stored in another form than abbe-solution/1", "solve the campaign again")
        return SolutionDetail(number=row["id"], runs=row["run_ids"], document=document, **row)


def _add_discoveries(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/discoveries")
    @needs(Permission.READ)
    def discoveries(campaign: Filter = None, machine: Filter = None, cursor: Cursor = None, limit: Limit = 50) -> Discoveries:
        """Searches for missing effects, newest first."""
        rows, after = sources.page("discoveries", {"campaign": campaign, "machine": machine}, cursor, limit)
        return Discoveries(discoveries=[Discovery(number=row["id"], **row) for row in rows], next_cursor=after)

    @app.get("/api/v1/discoveries/{number}")
    @needs(Permission.READ)
    def discovery(number: Number) -> DiscoveryDetail:
        """A search: its states, and what it found."""
        row = sources.row("discoveries", number, "discovery")
        steps = sources.store.discovery_steps(number)
        states = [DiscoveryState(state=one.state, utc=one.utc, why=str(one.doc.get("why", ""))) for one in steps]
        found: Doc | None = next((taken_back(one.doc["finding"]) for one in steps if "finding" in one.doc), None)
        answer = None if found is None else read_as(DiscoveryFile, found.get("answer"))
        told = None if found is None else found.get("changed")
        changed = None if told is None else ChangedSince.model_validate(told | {"proved": proved(told)})
        return DiscoveryDetail(number=row["id"], states=states, answer=answer, changed=changed, **row)
