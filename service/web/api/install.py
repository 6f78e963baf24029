"""Adds the interface to the application."""

from __future__ import annotations

from fastapi import FastAPI

from abbe.service.web.api.measured import add_measured
from abbe.service.web.api.plant import add_plant
from abbe.service.web.api.reports import add_reports
from abbe.service.web.api.results import add_results
from abbe.service.web.api.sources import Sources
from abbe.service.web.api.tables import add_tables


def add_api(app: FastAPI, sources: Sources) -> None:
    """Add every route of the interface to the application itself: the auth middleware reads permissions from the application's routes."""
    for add in (add_measured, add_results, add_tables, add_plant, add_reports):
        add(app, sources)
