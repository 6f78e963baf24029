"""Reports of stored objects (verifications and pushes with their whole journal among them), of campaign folders and of new solutions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import date, datetime
from pathlib import Path
from typing import Any

import numpy as np

from abbe.models.compensation.tables import NineTables
from abbe.service.campaign_data.campaign_folder import Campaign, from_folder, from_store
from abbe.service.domain.document import Doc
from abbe.service.domain.machine import Rules
from abbe.service.domain.measured import CampaignRecord, RunRecord
from abbe.service.domain.push_entry import TERMINAL, PushEntry, PushState
from abbe.service.domain.results import VerificationRecord
from abbe.service.domain.run import Run
from abbe.service.domain.solution_file import stored_solution
from abbe.service.errors import NotStored, StoreError, TableMismatch
from abbe.service.push.journal import BY_ROLLBACK, NO_PUSH, NOT_YET, PUSHED_BY, JournalBroken, PushFacts, check_chain, facts, push_log
from abbe.service.rendering.document import Document, PictureBlock, ReportFigure, Section, Sign, TextTable
from abbe.service.rendering.model import TableCurve
from abbe.service.rendering.plots.tables import table_plot
from abbe.service.report import report_parts as parts
from abbe.service.report.blocks import picture_section
from abbe.service.report.report_discovery import discovery_report
from abbe.service.report.report_measured import Measured, SolutionResult, campaign_report, run_report
from abbe.service.report.report_table import table_remarks
from abbe.service.runs.columns import load_run
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import tables_from_image
from abbe.service.tables.push_journal import JournalView
from abbe.service.verification.iso_report import Evaluated, evaluate
from abbe.service.verification.reduction import holds_at
from abbe.service.verification.verified_by import VerifiedBy, verified_by
from abbe.service.verification.verify import COVERAGE

NOT_JUDGED = "Not judged"


def with_later_changes(document: Document, store: Store, machine: str, begun_utc: str, runs: Sequence[Run]) -> Document:
    """Return the report, with a note if its table is not in force now. The verdict says so, too.

    ``begun_utc``: time of the measurement, or end of the push. ``runs``: runs of the report; without them only the time is compared.
    """
    known = verified_by(store, machine)
    if document.verdict is None or _same(known, begun_utc, runs):
        return document
    sign, word, text = document.verdict
    now = known.text[:1].upper() + known.text[1:]
    remark = f"this report is about the table in force at that time, not about the table in force now: {known.text}"
    verdict = document.verdict
    if known.state == "unverified" and word != NOT_JUDGED:
        verdict = ("open", "Unverified now", f"{now}. When this was measured: {word}. {text}".strip())
    elif sign != "open":
        verdict = ("open", f"{word} then", f"{text.rstrip('.')}. Another table is in force now: {known.text}.".removeprefix(". "))
    return replace(document, verdict=verdict, remarks=[remark, *document.remarks])


def _same(known: VerifiedBy, begun_utc: str, runs: Sequence[Run]) -> bool:
    """Whether the report was measured with the table in force now."""
    if known.why in ("changed", "open", "journal"):
        return False
    tables = {r.table.crc for r in runs if r.table.crc is not None}
    if known.why == "push" and tables == {known.crc}:  # measured during the push, before it was kept
        return True
    if known.since is not None and datetime.fromisoformat(begun_utc) < known.since:
        return False
    return known.crc is None or tables <= {known.crc}


MANY = 10**6
AXES = "XYZ"
VERDICTS: dict[str, tuple[Sign, str]] = {"pass": ("ok", "Passed"), "fail": ("bad", "Failed")}
ENDS: dict[PushState, tuple[Sign, str]] = {
    PushState.KEEP: ("ok", "Kept"),
    PushState.ACCEPTED: ("open", "Accepted by a person"),
    PushState.ROLLED_BACK: ("bad", "Rolled back: the old table is in force"),
    PushState.REJECTED: ("open", "Refused: nothing was written"),
    PushState.ABORTED: ("open", "Never in force: the old table stayed"),
    PushState.OPERATOR: ("bad", "A person has to look"),
}


def verification_report(store: Store, number: int, rules: Rules) -> Document:
    """Report of a stored verification with its runs.

    Raises
    ------
    NotStored
        The number does not exist.
    """
    record = next((v for v in store.verifications.latest(limit=MANY) if v.id == number), None)
    if record is None:
        raise NotStored(f"no verification {number} in the database", "`abbe serve` and `abbe correct` store verifications, numbered from 1")
    machine = store.machines.get(record.machine_id)
    campaign = None if record.campaign_id is None else from_store(store, store.campaigns.find(record.campaign_id).name)
    runs = [] if campaign is None else campaign.runs
    evaluated = Evaluated() if campaign is None else evaluate(runs, campaign.doc.get("instruments"), rules.materials)
    table = table_remarks(store, machine.name, runs)
    figures = verification_figures(record, rules)
    condition, remarks = parts.conditions(runs, rules)
    about = parts.machine_facts(machine.doc) | {"Verification": str(number), "Decided": record.utc}
    about |= {"Campaign": campaign.name} if campaign is not None else {}
    about |= _occasion(record.doc)
    sign, word = VERDICTS.get(record.verdict, ("open", record.verdict[:1].upper() + record.verdict[1:]))
    verdict = (sign, word, str(record.doc.get("text", "")))
    verdict = verdict if record.verdict == "fail" else table.verdict(verdict)  # a failed verification needs no other reason
    document = Document(
        kind="verification",
        title=f"Verification {number} of {machine.name}",
        about=about,
        verdict=verdict,
        figures=[*figures, *evaluated.figures],
        instruments=_instruments(campaign, rules),
        conditions=condition | evaluated.conditions,
        not_observable=evaluated.not_observable if campaign is not None else ["the readings: no campaign is stored with this verification"],
        remarks=[*table.remarks, *evaluated.remarks, *remarks],
        statements=[parts.VERIFICATION_STATEMENT, *evaluated.statements],
        provenance=parts.provenance(parts.data_digest(runs) if runs else parts.doc_digest(record.doc)),
        appendix=[*picture_section(evaluated.pictures), *evaluated.targets],
    )
    return with_later_changes(document, store, machine.name, str(record.doc.get("started_utc") or record.utc), runs)


def verification_figures(record: VerificationRecord, rules: Rules) -> list[ReportFigure]:
    """The figures that decided a verification, with the limits stored with it, else those of the machine file."""
    rows = _stored_rows(record.doc)
    limits = record.doc.get("limits") or rules.limits_um
    return parts.judged(rows, Rules({k: float(v) for k, v in limits.items() if v is not None}), f"Verification {record.id}")[0]


def _stored_rows(doc: Doc) -> dict[str, tuple[float, float]]:
    """Figures and standard uncertainties, µm. A correction stores standard uncertainties, a scheduled check expanded ones."""
    if "figures" in doc:
        return {k: (float(v["value"]), float(v["u"])) for k, v in doc["figures"].items()}
    expanded = doc.get("uncertainties") or {}
    rows = {k: (v, expanded.get(k)) for k, v in (doc.get("values") or {}).items()}
    return {k: (float(v), math.nan if u is None else float(u) / COVERAGE) for k, (v, u) in rows.items() if v is not None}


def _occasion(doc: Doc) -> dict[str, str]:
    """Occasion of the measurement: a push or a schedule."""
    names = {"push": "Of push", "schedule": "Schedule", "recipe": "Recipe", "slot_utc": "Due"}
    return {name: str(doc[key]) for key, name in names.items() if doc.get(key) is not None}


def _instruments(campaign: Campaign | None, rules: Rules) -> Any:
    return [] if campaign is None else parts.instruments(campaign.runs, campaign.doc, rules)


def push_report(store: Store, machine: str, number: int, rules: Rules) -> Document:
    """Report of a push: new and old table, approval, every transition of its journal, and the deciding verification.

    Raises
    ------
    NotStored
        The machine has no push of this number.
    """
    history = JournalView.read(store, machine, origins=False)
    entries = history.entries
    journal = tuple(e for e in entries if e.push == number != NO_PUSH)
    if not journal:
        raise NotStored(
            f"machine {machine!r} has no push {number}",
            f"number of its pushes: {len({e.push for e in entries} - {NO_PUSH})}; the first is push 1",
        )
    known = facts(journal)
    machine = known.machine or machine  # name of the machine at the time of the push
    doc = _machine_doc(store, machine)
    verified = [v for v in store.verifications.latest(limit=MANY) if _is_of(store, v, machine, number)]
    campaigns = [from_store(store, store.campaigns.find(v.campaign_id).name) for v in verified if v.campaign_id is not None]
    runs = [r for c in campaigns for r in c.runs]
    condition, remarks = parts.conditions(runs, rules) if runs else ({}, [])
    tables = _tables(known.image)
    lines = [(str(e.seq), line) for e, line in zip(journal, push_log(journal), strict=True)]
    document = Document(
        kind="push",
        title=f"Push {number} into {machine}",
        about=parts.machine_facts(doc) | _about(store, journal, known) | _holds_at(store, known, rules),
        verdict=_verdict(journal, known),
        figures=[f for v in verified for f in verification_figures(v, rules)] + _sizes(tables),
        instruments=[i for c in campaigns[:1] for i in parts.instruments(c.runs, c.doc, rules)],
        conditions=condition,
        not_observable=[] if verified else ["whether the machine became better: no verification is stored for this push"],
        remarks=[*_chain(entries), *remarks],
        statements=[
            "The controller adds the corrections to the command. They are shown as the independent decoder reads them, and have no U."
        ],
        provenance=parts.provenance(parts.doc_digest([e.digest for e in journal]))
        | {"Last entry of the journal (SHA-256)": journal[-1].digest, "Meaning of the table (SHA-256)": known.semantic_digest},
        appendix=[*_drawn(tables), Section("Journal", [TextTable(("Entry", "What happened"), lines)])],
    )
    return with_later_changes(document, store, machine, journal[-1].utc, []) if journal[-1].state is PushState.KEEP else document


def _is_of(store: Store, record: VerificationRecord, machine: str, push: int) -> bool:
    return record.doc.get("push") == push and store.machines.get(record.machine_id).name == machine


def _machine_doc(store: Store, machine: str) -> Doc:
    """The latest description of the machine."""
    return next(m.doc for m in reversed(store.machines.all()) if m.name == machine)


def _about(store: Store, journal: Sequence[PushEntry], known: PushFacts) -> dict[str, str]:
    sent, table = known.crc != NOT_YET, store.tables.get(known.table) if known.table else None
    solution = "" if table is None or table.solution_id is None else f", from solution {table.solution_id}"
    level = f"level {'unknown' if known.level == NOT_YET else known.level}"
    facts = {
        "Begun": journal[0].utc,
        "Last entry": journal[-1].utc,
        "State": str(journal[-1].state),
        "New table": f"CRC {known.crc:08X}, bank {known.target}" if sent else "",
        "Table before": f"CRC {known.base_crc:08X}, bank {known.base_bank}" if sent else "",
        "Stored as": "" if table is None else f"table {table.id}{solution}",
        "Capability of the control": level + (", a person is present" if known.attended else ""),
        **_who(known.approved_by),
        "Proof of sign, axis and unit": known.probe,
        "Verification": known.verify,
    }
    return {name: text for name, text in facts.items() if text}


def _who(approved_by: str) -> dict[str, str]:
    """Approver and pusher, as the journal states them; without an approval of another person, the pusher."""
    approver, _, pusher = approved_by.rpartition(PUSHED_BY)
    if approver or not pusher:
        return {"Approved by": approver, "Pushed by": pusher}
    if pusher.endswith(BY_ROLLBACK):
        return {"Rolled back by": pusher.removesuffix(BY_ROLLBACK)}
    return {"Pushed by": pusher, "Approval": "no second person was asked for"}


def _holds_at(store: Store, known: PushFacts, rules: Rules) -> dict[str, str]:
    """Return the temperature at which the new table holds: the scales' temperature during the table's runs. Tables are not reduced to 20
    °C."""
    solution_id = store.tables.get(known.table).solution_id if known.table else None
    if solution_id is None:
        return {}
    runs = [load_run(store, number) for number in store.solutions.get(solution_id).run_ids]
    return {"Table holds at": holds_at(runs, rules.materials)}


def _verdict(journal: Sequence[PushEntry], known: PushFacts) -> tuple[Sign, str, str]:
    state = journal[-1].state
    sign, word = ENDS.get(state, ("open", "Not ended"))
    why = known.why or known.verify or "; ".join(known.reasons)
    return sign, word, (why or f"the push is in state {state}") + ("" if state in TERMINAL else f" (state {state})")


def _chain(entries: Sequence[PushEntry]) -> list[str]:
    try:
        check_chain(entries)
    except JournalBroken as error:
        return [f"THE JOURNAL WAS CHANGED: {error}"]
    return []


def _tables(image: bytes) -> NineTables | None:
    try:
        return tables_from_image(image) if image else None
    except TableMismatch:
        return None


def _drawn(tables: NineTables | None) -> list[Section]:
    if tables is None:
        return []
    return picture_section([PictureBlock("The new table: what is added to the command.", [table_plot(_curves(tables))], "wide")])


def _curves(tables: NineTables) -> list[TableCurve]:
    return [TableCurve(AXES[a], AXES[i], tables.position_mm[a], tables.correction_mm[a][:, i] * 1e3) for a in range(3) for i in range(3)]


def _sizes(tables: NineTables | None) -> list[ReportFigure]:
    if tables is None:
        return []
    out = []
    for curve in _curves(tables):
        size = float(np.abs(np.asarray(curve.correction_um)).max())
        name = f"largest correction of {curve.axis_out} when {curve.axis_in} moves"
        out.append(
            ReportFigure("Corrections of the new table", f"{curve.axis_in} to {curve.axis_out}", name, size, None, "µm", "as stored")
        )
    return out


def certified(document: Document, rules: Rules, measured_on: date | None, issued: date) -> Document:
    """The report as a certificate of the laboratory that the rules name, if any. ``measured_on``: day of the measurement, for a report
    without it; ``issued``: day of issue."""
    days = document.days or (None if measured_on is None else (measured_on.isoformat(), measured_on.isoformat()))
    return replace(document, issuer=rules.issuer, item=rules.item, days=days, issued=issued.isoformat())


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
    names = list(dict.fromkeys(m.name for m in store.machines.all()))
    if machine is not None:
        if machine not in names:
            raise NotStored(f"no machine {machine!r} in the database", f"known are {', '.join(names) or 'none'}")
        names = [machine]
    chains = {store.pushes.chain(n): n for n in names}  # machines that were renamed share one
    having = [n for chain, n in chains.items() if any(e.push == number for e in store.pushes.entries_of(chain))]
    if len(having) != 1:
        if not having:
            raise NotStored(f"no push {number} in the database", "`abbe correct` pushes tables; the first push of a machine is push 1")
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
