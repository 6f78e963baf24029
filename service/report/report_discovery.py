"""A discovery as a report: missing effects, their size, evidence, rival explanations and remedies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from abbe.models.arrays import F1
from abbe.service.campaign_data.campaign_folder import Campaign, from_store
from abbe.service.campaign_data.decimation import thinned
from abbe.service.discovery.changed_text import changed_lines, changed_text
from abbe.service.discovery.discover import DiscoveryJob, DiscoveryJournal
from abbe.service.discovery.discovery_states import entering
from abbe.service.discovery.discovery_store import stored_steps
from abbe.service.discovery.discovery_text import (
    ROLES,
    book_lines,
    location_lines,
    next_of,
    parameter_text,
    rival_lines,
    size_text,
    unseen_lines,
    verdict_of,
)
from abbe.service.discovery.effect_pages import unit
from abbe.service.domain.finding import EffectFound, Finding
from abbe.service.domain.machine import Rules
from abbe.service.domain.run import Run
from abbe.service.effects.model_book import REMEDIES
from abbe.service.errors import StoreError
from abbe.service.rendering.document import Block, Document, Facts, Lines, PictureBlock, ReportFigure, Section, Sign, TextTable
from abbe.service.rendering.model import PlaceMap, ResidualTrace
from abbe.service.rendering.numbers import NOT_AVAILABLE, plain
from abbe.service.rendering.plots.gap import gap_bars, place_plot, trace_plot
from abbe.service.report import report_parts as parts
from abbe.service.storage.store import Store

AXES = "XYZ"
CELLS = 24
"""Cells of the map along the longer side of the measured area."""
FEWEST = 3
"""A cell with fewer readings is not drawn."""
REJECTED = 40
DECIDED = "How it was decided"
SIGNS: dict[str, Sign] = {"ok": "ok", "open": "open", "bad": "bad"}
STATEMENTS = (
    "U of a named effect is from a fit of the effect together with all other parameters that these runs leave free.",
    "Gap: measured minus simulated; deviation = actual − nominal, tool relative to workpiece (ISO 230-1). Roles of runs: identify is "
    "fitted; holdout is never fitted, and only judges; sealed is predicted without knowledge of the readings.",
)


@dataclass(frozen=True)
class _Found:
    """A finding with its campaign, the searched runs, flags (warnings), and the states of the search with their reasons."""

    finding: Finding
    campaign: Campaign
    runs: Sequence[Run]
    flags: Sequence[str]
    states: Sequence[tuple[str, str]]

    @property
    def measured(self) -> dict[str, Run]:
        """Runs with readings (not sealed), by name."""
        return {r.run_id: r for r in self.runs if not r.is_sealed}


def discovery_report(store: Store, number: int, rules: Rules) -> Document:
    """Report of a stored discovery, without a new search.

    Raises
    ------
    StoreError
        The discovery does not exist or has not ended.
    """
    record = store.discoveries.get(number)
    steps = stored_steps(store, number)
    finding = next((step.finding for step in steps if step.finding is not None), None)
    start = steps[0].start if steps else None
    if finding is None or start is None:
        raise StoreError(f"discovery {number} has not ended", "repeat the same abbe discover command: it resumes there")
    name = next(c.name for c in store.campaigns.all() if c.id == record.campaign_id)
    campaign = from_store(store, name)
    found = _Found(finding, campaign, thinned(campaign.runs), start.flags, [(step.state, step.why) for step in steps])
    ended = store.discoveries.steps(number)[-1].utc
    about = {"Begun": record.created_utc, "Ended": ended, "State": steps[-1].state, "Present model": ", ".join(start.present_model)}
    made = parts.provenance(parts.data_digest(campaign.runs), dict(start.source.versions)) | {"Search (SHA-256)": record.digest}
    title = f"Discovery {number}: what the simulation of {campaign.site.name} lacks"
    return _document(found, title, about, made, rules)


def found_report(job: DiscoveryJob, journal: DiscoveryJournal, finding: Finding, made_utc: str) -> Document:
    """Report of a new discovery, stored or not: a working paper without signatures."""
    title = f"Campaign {job.campaign.name} - what the simulation of {job.campaign.site.name} lacks"
    return _document(_of_job(job, journal, finding), title, _about(job, made_utc), _provenance(job, journal), Rules(), signed=False)


def simulation_report(job: DiscoveryJob, finding: Finding, verdict: tuple[str, str, str], made_utc: str) -> Document:
    """Report that compares measured with simulated readings, without a search. ``verdict``: sign, word and sentence."""
    title = f"Campaign {job.campaign.name} - measured against simulated"
    found = _of_job(job, DiscoveryJournal(), finding)
    made = _provenance(job, DiscoveryJournal())
    return _document(found, title, _about(job, made_utc), made, Rules(), verdict=verdict, signed=False)


def _of_job(job: DiscoveryJob, journal: DiscoveryJournal, finding: Finding) -> _Found:
    return _Found(finding, job.campaign, job.runs, job.flags, [(step.state, step.why) for step in journal.steps])


def _about(job: DiscoveryJob, made_utc: str) -> dict[str, str]:
    out = {"Runs": str(len(job.campaign.runs)), "Made": made_utc, "Present model": ", ".join(sorted(job.case.includes))}
    return out | {"Catalogue": f"{len(job.effects)} effects"}


def _provenance(job: DiscoveryJob, journal: DiscoveryJournal) -> dict[str, str]:
    out = parts.provenance(parts.data_digest(job.campaign.runs), {k: str(v) for k, v in job.source.versions.items()})
    if journal.id is not None:
        out["Stored"] = f"discovery {journal.id}" + (f", model version {journal.version}" if journal.version else "")
    return out | {"Search (SHA-256)": job.digest}


def _document(
    found: _Found,
    title: str,
    about: Mapping[str, str],
    provenance: Mapping[str, str],
    rules: Rules,
    *,
    verdict: tuple[str, str, str] | None = None,
    signed: bool = True,
) -> Document:
    finding, campaign = found.finding, found.campaign
    sign, word, text = verdict or _verdict(finding)
    condition, remarks = parts.conditions(campaign.runs, rules)
    document = Document(
        kind="discovery" if verdict is None else "simulation",
        title=title,
        about=parts.machine_facts(campaign.site.doc) | {"Campaign": campaign.name} | dict(about),
        verdict=(SIGNS[sign], word, text),
        remarks=[*found.flags, *book_lines(finding), *remarks],
        sections=_sections(found),
        figures=_figures(finding),
        statements=STATEMENTS,
        not_observable=_open(finding),
        instruments=parts.instruments(campaign.runs, campaign.doc, rules),
        conditions=condition,
        appendix=_appendix(found),
        provenance=provenance,
    )
    return document if signed else replace(document, signatures=())


def _verdict(finding: Finding) -> tuple[str, str, str]:
    """Verdict of the finding, with the changes since an earlier solution, if one could be compared."""
    sign, word, text = verdict_of(finding)
    changes = changed_text(finding.changed)
    return sign, word, f"{text} {changes[:1].upper()}{changes[1:]}." if changes else text


def _sections(found: _Found) -> list[Section]:
    finding = found.finding
    out = [Section(f"{e.full_title}: {size_text(e)}", [Facts(_card(e))]) for e in finding.effects]
    if changed := changed_lines(finding.changed):
        out.append(Section("What has changed", [Lines([line.strip() for line in changed])]))
    if located := location_lines(finding.location):
        out.append(Section("Where the gap is", [Lines(located)]))
    out.append(Section("The gap before and after", [gap_table(finding), *_pictures(found)]))
    following = next_of(finding)
    if following or finding.effects:
        text = Lines([line.strip() for line in following]) if following else "No further measurement is needed to separate the suspects."
        out.append(Section("What to measure next", [text]))
    return out


def _card(effect: EffectFound) -> dict[str, str]:
    """Remedy, signature, rivals and parameters of a named effect."""
    there = "; ".join(location_lines(effect.location))
    out = {"What to do": effect.remedy_text, "What removes it": REMEDIES[effect.remedy]}
    out |= ({"Where": there} if there else {}) | {"How it looks": effect.signature, "What else it could be": "; ".join(rival_lines(effect))}
    out |= {"Look at the data": effect.sensor_doubt} if effect.sensor_doubt else {}
    out |= {name.replace("_", " ").capitalize(): parameter_text(p) for name, p in effect.parameters.items()}
    out["Evidence"] = f"{plain(effect.evidence)} (natural logarithm of how much likelier the effect makes the readings, less a penalty)"
    if effect.forms:
        out["Form"] = "differs from the textbook's: " + ", ".join(effect.forms)
    return out | {"Source": effect.source}


def gap_table(finding: Finding) -> TextTable:
    """Return the table of the gap (measured minus simulated), one row per role of runs.

    Fitted runs have no entry under "Gap closed": the fit makes their residuals smaller than those of new runs.
    Sealed runs are only counted: their readings are unknown here.
    """
    only_scatter = bool(finding.effects) and not entering(finding)  # explained scatter closes no gap
    by = "" if finding.effects or not _what(finding) else f" by {_what(finding)}"
    head = ("Runs", "Before (µm)", "After (µm)", "Noise floor (µm)", f"Gap closed{by}", "What they are for")
    rows: list[tuple[str, ...]] = []
    for role, g in finding.gaps.items():
        closed = NOT_AVAILABLE if only_scatter or g.closed is None or role == "identify" else f"{100.0 * g.closed:.0f} %"
        rows.append((role, plain(g.before_um), plain(g.after_um), plain(g.floor_um), closed, ROLES.get(role, "")))
    sealed = sum(r.role == "sealed" for r in finding.runs.values())
    if sealed:
        rows.append(("sealed", *[NOT_AVAILABLE] * 4, f"{sealed} runs predicted; their readings are unknown here"))
    return TextTable(head, rows)


def _what(finding: Finding) -> str:
    """Say what was added to the model between the gap before and the gap after; empty if nothing was."""
    return {"none": "", "named": "what was found", "unknown": "a structure without a name"}[finding.verdict]


def _pictures(found: _Found) -> list[Block]:
    finding = found.finding
    out: list[Block] = []
    if finding.runs:
        text = "Measured minus simulated, run by run. Where the lower bar ends at the dashed tick, nothing but noise is left."
        out.append(PictureBlock(text, [gap_bars(finding.runs)], "wide"))
    traces = [trace_plot(t, key=f"trace-{i}") for i, t in enumerate(_traces(found))]
    if traces:
        what = _what(finding)
        text = f"The run that shows most, simulated without and with {what}" if what else "The run with the largest gap; nothing was added"
        out.append(PictureBlock(f"{text}. Both panels have one scale; band: ± 2 standard deviations of the noise.", traces, "wide"))
    places = [place_plot(p, key=f"place-{i}") for i, (a, b) in enumerate(((0, 1), (0, 2))) if (p := _place(found, a, b)) is not None]
    if places:
        text = (
            "Gap of the present model, divided by the noise of one reading, for each cell of the measured area."
            " A ring marks the located area."
        )
        out.append(PictureBlock(text, places))
    return out


def _figures(finding: Finding) -> list[ReportFigure]:
    out = []
    for e in finding.effects:
        group = f"Effect: {e.full_title}"
        out.append(ReportFigure(group, e.label, e.title, e.strength, e.u_strength, unit(e.unit), e.source))
        out += [ReportFigure(group, n, n.replace("_", " "), p.value, p.u, unit(p.unit)) for n, p in e.parameters.items()]
    for role, gap in finding.gaps.items():
        group = f"Gap of the {role} runs"
        out.append(ReportFigure(group, "before", "measured minus simulated, rms", gap.before_um, None, "µm"))
        if what := _what(finding):
            out.append(ReportFigure(group, "after", f"the same with {what}", gap.after_um, None, "µm"))
        out.append(ReportFigure(group, "floor", "noise", gap.floor_um, None, "µm"))
    return out


def _open(finding: Finding) -> list[str]:
    out = ["these runs cannot tell the finding from: " + ", ".join(finding.confounded_with)] if finding.confounded_with else []
    out += [f"{e.full_title} could also be: {line}" for e in finding.effects for line in rival_lines(e)]
    return out + unseen_lines(finding)


def _appendix(found: _Found) -> list[Section]:
    finding = found.finding
    runs = [
        (label, r.test, r.role, str(r.readings), plain(r.rms_before_um), plain(r.rms_after_um), plain(r.floor_um))
        for label, r in finding.runs.items()
    ]
    out = [Section("Runs", [TextTable(("Run", "Test", "Role", "Readings", "Before, µm", "After, µm", "Noise, µm"), runs)])]
    if finding.location.table:
        tests = [(t.kind, t.value, plain(t.statistic), f"{t.p:.2g}") for t in finding.location.table]
        table = TextTable(("Against", "Which", "Statistic", "p (all tests together)"), tests)
        out.append(Section(f"Tests of where the gap is: {len(tests)}", [table], folded=True))
    if rejected := finding.rejected[:REJECTED]:
        out.append(Section(f"What was tried and why not: {len(rejected)}", [TextTable(("Effect", "Why"), rejected)], folded=True))
    return [*out, Section(DECIDED, [TextTable(("State", "Why"), found.states)])]


def telling_run(finding: Finding) -> str | None:
    """Return the run whose gap, relative to its noise, closes most; without a finding, the run with the largest such gap."""
    shows = {}
    for label, run in finding.runs.items():
        if run.rms_before_um is not None and run.rms_after_um is not None:
            after_um = run.rms_after_um if finding.effects else 0.0
            shows[label] = (run.rms_before_um**2 - after_um**2) / run.floor_um**2
    return max(shows, key=lambda label: shows[label], default=None)


def _traces(found: _Found) -> list[ResidualTrace]:
    """Traces of the run that `telling_run` names: against time and, if an axis is named, against its position."""
    finding, label = found.finding, telling_run(found.finding)
    if label is None:
        return []
    columns, series = found.measured[label].columns, finding.series[label]
    if series.before is None or series.after is None:
        return []
    before, after = series.before.values_mm * 1e3, series.after.values_mm * 1e3
    noise, why = finding.runs[label].floor_um, "the gap shows most here"
    out = [ResidualTrace(label, "time of the session in s", columns.t_s, before, after, noise, why)]
    key = finding.effects[0].key if finding.effects else "".join(finding.location.axes[:1])
    if key[-1:] in AXES and key:
        x = columns.q_mm[:, AXES.index(key[-1])]
        if float(np.ptp(x)) > 0.0:
            out.append(ResidualTrace(label, f"position of {key[-1]} in mm", x, before, after, noise, why))
    return out


def _place(found: _Found, a: int, b: int) -> PlaceMap | None:
    """Return a map over axes ``a`` and ``b``: in each cell the rms of measured minus simulated, divided by the noise.

    None if there are no readings, or all lie at one place.
    """
    points, ratio = _points(found)
    if not len(points):
        return None
    x, y = points[:, a], points[:, b]
    side = max(float(np.ptp(x)), float(np.ptp(y))) / CELLS
    if side <= 0.0:
        return None
    cells, which = np.unique(np.floor(np.column_stack([x, y]) / side), axis=0, return_inverse=True)
    count = np.bincount(which.ravel())
    keep = count >= FEWEST
    times = np.sqrt(np.bincount(which.ravel(), weights=ratio**2) / count)[keep]
    centre = (cells[keep] + 0.5) * side
    spot, location = None, found.finding.location
    if location.position_mm is not None:
        spot = (location.position_mm[a], location.position_mm[b], location.radius_mm or 0.0)
    return PlaceMap(AXES[a], AXES[b], centre[:, 0], centre[:, 1], times, spot)


def _points(found: _Found) -> tuple[F1, F1]:
    """Positions of all judged readings, shape (n, 3), mm, and their gap divided by the noise, shape (n,)."""
    places, ratios = [np.zeros((0, 3))], [np.zeros(0)]
    for label, run in found.measured.items():
        before = found.finding.series[label].before
        if before is None:
            continue
        gap = before.values_mm * 1e3 / found.finding.runs[label].floor_um
        keep = np.isfinite(gap)
        places.append(run.columns.q_mm[keep])
        ratios.append(gap[keep])
    return np.concatenate(places), np.concatenate(ratios)
