"""Reports of stored objects, of campaign folders and of new solutions."""

from __future__ import annotations

from dataclasses import replace
from datetime import date
from pathlib import Path

from abbe.service.campaign_data.campaign_folder import Campaign, from_folder, from_store
from abbe.service.config_schema import MachineFile
from abbe.service.domain.measured import CampaignRecord, RunRecord
from abbe.service.domain.solution_file import stored_solution
from abbe.service.errors import NotStored, StoreError
from abbe.service.rendering.document import Document, Issuer
from abbe.service.report.later_changes import with_later_changes
from abbe.service.report.report_discovery import discovery_report
from abbe.service.report.report_done import push_report, verification_report
from abbe.service.report.report_measured import Measured, SolutionResult, campaign_report, run_report
from abbe.service.report.report_parts import Rules
from abbe.service.report.report_table import table_remarks
from abbe.service.runs.columns import load_run
from abbe.service.storage.store import Store

NUMBERED = ("push", "discovery", "verification")


def rules_of(config: MachineFile | None) -> Rules:
    """Limits of the check, certificates, allowed temperature and expansion from a machine file; empty without a file."""
    if config is None:
        return Rules()
    limits = {"body_diagonal_um": config.verify.body_diagonal_um, "helix_rms_um": config.verify.helix_rms_um}
    days = {"ballbar": config.calibration.ballbar, "laser": config.calibration.laser}
    return Rules(limits, {k: v for k, v in days.items() if v is not None}, config.limits.temperature_c, config.material.by_axis())


def certified(document: Document, config: MachineFile | None, measured_on: date | None) -> Document:
    """The report with the issuer of a digital certificate from a machine file and, where it has none, the day of the measurement."""
    days = document.days or (None if measured_on is None else (measured_on.isoformat(), measured_on.isoformat()))
    issuer = None if config is None or config.issuer is None else Issuer(**config.issuer.model_dump())
    return replace(document, issuer=issuer, days=days)


def numbered_report(store: Store, what: str, number: int, rules: Rules, machine: str | None = None) -> Document:
    """Report of push, discovery or verification ``number``; ``machine``: owner of the push, needed if several have this number.

    Raises
    ------
    NotStored
        The number does not exist.
    StoreError
        Several machines have a push of this number.
    """
    if what == "discovery":
        return discovery_report(store, number, rules)
    if what == "verification":
        return verification_report(store, number, rules)
    names = list(dict.fromkeys(m.name for m in store.machines.all())) if machine is None else [machine]
    chains = {store.pushes.chain(n): n for n in names}  # machines that were renamed share one
    having = [n for chain, n in chains.items() if any(e.push == number for e in store.pushes.entries_of(chain))]
    if len(having) != 1:
        if not having:
            raise NotStored(f"no push {number} in the database", "`abbe correct` pushes tables; their numbers begin with 1")
        raise StoreError(f"machines {', '.join(having)} each have a push {number}", "name the machine: --of NAME")
    return push_report(store, having[0], number, rules)


def stored_report(store: Store, record: RunRecord | CampaignRecord, rules: Rules) -> Document:
    """Report of a stored run or campaign."""
    if isinstance(record, CampaignRecord):
        return _with_later_changes(store, _measured(store, record.name), record.created_utc, rules)
    campaign = from_store(store, record.campaign)
    if all(r.run_id != record.label for r in campaign.runs):  # an incomplete run is reported as such
        campaign = Campaign(campaign.name, campaign.site, [*campaign.runs, load_run(store, record.id)], None, campaign.doc)
    facts = {"Started": record.started_utc, "Ended": record.ended_utc or "not ended"}
    runs = [r for r in campaign.runs if r.run_id == record.label]
    table = table_remarks(store, campaign.site.name, runs)
    document = run_report(Measured(campaign, facts, [_state(record)], table=table), record.label, rules)
    return with_later_changes(document, store, campaign.site.name, record.started_utc, runs)


def solution_report(store: Store | None, campaign: Campaign, solution: SolutionResult, made_utc: str, rules: Rules) -> Document:
    """Report of a campaign with a new solution and its pictures.

    ``store``: database of the campaign; the report then names unfinished runs and the table in force. ``campaign``: the solved runs.
    ``made_utc``: time of the solution.
    """
    solved = {"Solved": made_utc}
    if store is None or campaign.folder is not None:
        return campaign_report(Measured(campaign, solved, solution=solution), rules)
    found = _measured(store, campaign.name)
    left_out = {r.run_id for r in found.campaign.runs} - {r.run_id for r in campaign.runs}
    states = [s for s in found.states if s[0] not in left_out]
    found = replace(found, campaign=campaign, facts=found.facts | solved, states=states, solution=solution)
    return _with_later_changes(store, found, store.campaigns.find(campaign.name).created_utc, rules)


def _with_later_changes(store: Store, found: Measured, created_utc: str, rules: Rules) -> Document:
    return with_later_changes(campaign_report(found, rules), store, found.campaign.site.name, created_utc, found.campaign.runs)


def folder_report(folder: Path, rules: Rules) -> Document:
    """Report of a campaign folder: figures by ISO 230, without a solution."""
    return campaign_report(Measured(from_folder(folder)), rules)


def _measured(store: Store, name: str) -> Measured:
    record = store.campaigns.find(name)
    runs = store.runs.all(record.id)
    imported = "imported" in record.doc  # its runs bear the time of the import
    facts, days = {"Imported" if imported else "Created": record.created_utc}, None
    if runs and not imported:
        begun, ends = min(r.started_utc for r in runs), [r.ended_utc for r in runs if r.ended_utc]
        facts |= {"First run started": begun} | ({"Last run ended": max(ends)} if ends else {})
        days = (begun[:10], max([begun, *ends])[:10])
    solved = next((s for s in reversed(store.solutions.all(record.id)) if "mean_over_volume" in s.doc), None)
    solution = None if solved is None else SolutionResult(stored_solution(solved.doc, solved.id), solved.id)
    campaign = from_store(store, name)
    table = table_remarks(store, campaign.site.name, campaign.runs)
    return Measured(campaign, facts, [_state(r) for r in runs], solution, table, days)


def _state(run: RunRecord) -> tuple[str, ...]:
    return run.label, run.test, run.role, run.visible_status, run.reason
