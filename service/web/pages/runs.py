"""Runs for the screens: a filtered list, and one run with its figures and pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.devices.urls import DeviceUrls
from abbe.service.domain.measured import RunRecord
from abbe.service.domain.run import Run
from abbe.service.errors import AbbeError
from abbe.service.queries.measured import RunSummary, campaigns, runs_by_state
from abbe.service.queries.reader import Reader
from abbe.service.rendering.document import Document
from abbe.service.report.report_measured import Measured, run_report
from abbe.service.report.report_parts import Rules
from abbe.service.runs.cases import with_earliest_mounting
from abbe.service.runs.columns import load_run
from abbe.service.site import Site, machine_from_doc
from abbe.service.storage.store import Store

TESTS = ("ballbar_helix", "ballbar_circle", "laser_diagonal", "laser_linear")
STATES = ("complete", "running", "incomplete", "stopped", "aborted", "failed", "interrupted", "disk_full")
MOST = 100
MOST_CAMPAIGNS = 50


@dataclass(frozen=True, slots=True)
class RunsQuery:
    """Filter of the list of runs; empty fields match all."""

    campaign: str = ""
    test: str = ""
    state: str = ""


@dataclass(frozen=True, slots=True)
class RunListing:
    """The newest matching runs, whether there are more, and the campaigns to choose from."""

    runs: list[RunSummary]
    more: bool
    campaigns: list[str]


@dataclass(frozen=True, slots=True)
class RunScreen:
    """One run. ``document``: its report, None if the run is unreadable; ``trouble``: the reason."""

    record: RunRecord
    document: Document | None
    trouble: str = ""


def run_list(reader: Reader, query: RunsQuery) -> RunListing:
    """The newest matching runs."""
    names = [one.name for one in campaigns(reader, None, None, MOST_CAMPAIGNS)[0]]
    found, more = runs_by_state(reader, query.campaign, query.test, query.state, MOST)
    return RunListing(found, more, names)


def run_screen(store: Store, record: RunRecord, rules: Rules) -> RunScreen:
    """A run with its report, judged by the limits and certificates of the machine file; ``trouble`` if it is unreadable."""
    try:
        return RunScreen(record, run_document(store, record, rules)[1])
    except AbbeError as error:
        return RunScreen(record, None, error.detail)
    except (KeyError, TypeError, ValueError, IndexError) as error:  # another version wrote the document, or somebody edited it
        return RunScreen(record, None, f"{type(error).__name__}: {error}")


def run_document(store: Store, record: RunRecord, rules: Rules) -> tuple[Run, Document]:
    """A run and its report."""
    owner = store.campaigns.find(record.campaign_id)
    machine: dict[str, Any] = store.machines.get(owner.machine_id).doc
    run = with_earliest_mounting([load_run(store, record.id)])[0]
    site = Site(str(machine.get("name") or record.campaign), machine_from_doc(machine), machine, DeviceUrls())
    known = owner.doc.get("imported") or owner.doc
    return run, run_report(Measured(Campaign(record.campaign, site, [run], None, known)), record.label, rules)
