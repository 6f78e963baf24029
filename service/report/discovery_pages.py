"""A finding and the runs it is about as the values of its page."""

from __future__ import annotations

from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.service.discovery.changed_words import changed_lines, changed_words
from abbe.service.discovery.discover import DiscoveryJob, DiscoveryJournal
from abbe.service.discovery.discovery_states import entering
from abbe.service.discovery.discovery_words import (
    ROLES,
    next_of,
    parameter_text,
    rival_lines,
    size,
    verdict_of,
    where_lines,
)
from abbe.service.domain.finding import EffectFound, Finding, RunFit
from abbe.service.effects.model_book import REMEDIES
from abbe.service.rendering.discovery_model import DiscoveryPage, EffectCard, GapRow, PlaceMap, RunGap, Trace
from abbe.service.rendering.numbers import plain

AXES = "XYZ"
CELLS = 24
"""Cells of the map along the longer side of what was measured."""
FEWEST = 3
"""Readings that a cell needs."""
REJECTED = 40


def page_facts(job: DiscoveryJob, journal: DiscoveryJournal, made: str) -> tuple[dict[str, str], dict[str, Any]]:
    """Head, states and provenance of a discovery's page; ``made``: when, as text."""
    machine, source = job.campaign.site.name, job.source
    facts = {"machine": machine, "chain": job.case.machine.chain, "runs": str(len(job.campaign.runs)), "made": made}
    provenance = {"campaign": job.campaign.name, "present model": ", ".join(sorted(job.case.includes))}
    provenance["catalogue"] = f"{len(job.effects)} effects"
    provenance |= {name: str(v) for name, v in source.versions.items()}
    if journal.id is not None:
        provenance["stored"] = f"discovery {journal.id}" + (f", model version {journal.version}" if journal.version else "")
    provenance["SHA-256 of the search"] = job.digest
    states = [(step.state, step.why) for step in journal.steps]
    title = f"Campaign {job.campaign.name} - what the simulation of {machine} lacks"
    return facts, {"title": title, "flags": list(job.flags), "states": states, "provenance": provenance}


def discovery_page(finding: Finding, runs: list[dict[str, Any]], facts: dict[str, str], told: dict[str, Any]) -> DiscoveryPage:
    """Everything the page shows.

    Parameters
    ----------
    finding : Finding
    runs : list of dict
        ``abbe-run/1`` objects of the campaign.
    facts : dict
        Campaign, machine, ... for the head of the page.
    told : dict
        ``title``, ``flags``, ``states`` (state, why) and ``provenance``; ``verdict`` where it is not the finding's.
    """
    measured = {r["run_id"]: r for r in runs if r["columns"]["deviation_mm"] is not None}
    return DiscoveryPage(
        title=told["title"],
        facts=facts,
        verdict=told.get("verdict") or _verdict(finding),
        effects=[_card(e) for e in finding.effects],
        located=where_lines(finding.where),
        changed=changed_lines(finding.changed),
        gaps=gap_rows(finding),
        runs=[_run(label, run) for label, run in finding.runs.items()],
        traces=_traces(finding, measured),
        places=[p for p in (_place(finding, measured, a, b) for a, b in ((0, 1), (0, 2))) if p is not None],
        tests=[(t.kind, t.value, plain(t.statistic), f"{t.p:.2g}") for t in finding.where.table],
        next_test=next_of(finding),
        rejected=list(finding.rejected[:REJECTED]),
        flags=told["flags"],
        states=told["states"],
        provenance=told["provenance"],
        found={"none": "", "named": "what was found", "unknown": "a structure without a name"}[finding.verdict],
    )


def _verdict(finding: Finding) -> tuple[str, str, str]:
    """The finding's, with what has changed where an earlier solution could be compared."""
    sign, word, text = verdict_of(finding)
    changes = changed_words(finding.changed)
    return sign, word, f"{text} {changes[:1].upper()}{changes[1:]}." if changes else text


def gap_rows(finding: Finding) -> list[GapRow]:
    """The gap by role; sealed runs are only counted: their readings are unknown here."""
    only_scatter = bool(finding.effects) and not entering(finding)  # closes no gap, and need not
    rows = [
        GapRow(role, ROLES.get(role, ""), g.before_um, g.after_um, g.floor_um, None if only_scatter else g.closed)
        for role, g in finding.gaps.items()
    ]
    sealed = [r for r in finding.runs.values() if r.role == "sealed"]
    if sealed:
        rows.append(GapRow("sealed", f"{len(sealed)} runs predicted, their readings are unknown here", None, None, None, None))
    return rows


def _card(effect: EffectFound) -> EffectCard:
    facts = {name: parameter_text(p) for name, p in effect.parameters.items()}
    facts["evidence"] = f"{plain(effect.evidence)} (natural logarithm of how much more likely the readings are with it, after its price)"
    if effect.forms:
        facts["form"] = "not quite the textbook's: " + ", ".join(effect.forms)
    return EffectCard(
        name=effect.words,
        size=size(effect),
        facts=facts,
        where="; ".join(where_lines(effect.where)),
        do=effect.remedy_text,
        remedy=REMEDIES[effect.remedy],
        signature=effect.signature,
        rivals=rival_lines(effect),
        source=effect.source,
    )


def _run(label: str, run: RunFit) -> RunGap:
    return RunGap(label, run.test, run.role, run.readings, run.rms_before_um, run.rms_after_um, run.floor_um)


def telling_run(finding: Finding) -> str | None:
    """The run in which most of the gap closes, against its noise; where nothing was found, the one with the largest gap."""
    shows = {}
    for label, run in finding.runs.items():
        if run.rms_before_um is not None and run.rms_after_um is not None:
            after_um = run.rms_after_um if finding.effects else 0.0
            shows[label] = (run.rms_before_um**2 - after_um**2) / run.floor_um**2
    return max(shows, key=lambda label: shows[label], default=None)


def _traces(finding: Finding, measured: dict[str, dict[str, Any]]) -> list[Trace]:
    """The run that shows most: along time and, where an axis is named, against its position."""
    label = telling_run(finding)
    if label is None:
        return []
    columns, series = measured[label]["columns"], finding.series[label]
    if series.before is None or series.after is None:
        return []
    before, after = series.before.values_mm * 1e3, series.after.values_mm * 1e3
    noise, why = finding.runs[label].floor_um, "the gap shows most here"
    t = np.asarray(columns["t_s"], dtype=np.float64)
    out = [Trace(label, "time of the session in s", t, before, after, noise, why)]
    key = finding.effects[0].key if finding.effects else "".join(finding.where.axes[:1])
    if key[-1:] in AXES and key:
        x = np.asarray(columns[f"{key[-1].lower()}_mm"], dtype=np.float64)
        if float(np.ptp(x)) > 0.0:
            out.append(Trace(label, f"position of {key[-1]} in mm", x, before, after, noise, why))
    return out


def _place(finding: Finding, measured: dict[str, dict[str, Any]], a: int, b: int) -> PlaceMap | None:
    """Cells of one plane with the rms of the gap before over its noise."""
    points, ratio = _points(finding, measured)
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
    spot, at = None, finding.where.position_mm
    if at is not None:
        spot = (at[a], at[b], finding.where.radius_mm or 0.0)
    return PlaceMap(AXES[a], AXES[b], centre[:, 0], centre[:, 1], times, spot)


def _points(finding: Finding, measured: dict[str, dict[str, Any]]) -> tuple[F1, F1]:
    """Where every judged reading was taken, shape (n, 3), and its gap over the noise, shape (n,)."""
    places, ratios = [np.zeros((0, 3))], [np.zeros(0)]
    for label, run in measured.items():
        columns, before = run["columns"], finding.series[label].before
        if before is None:
            continue
        gap = before.values_mm * 1e3 / finding.runs[label].floor_um
        keep = np.isfinite(gap)
        places.append(np.column_stack([np.asarray(columns[f"{c}_mm"], dtype=np.float64) for c in "xyz"])[keep])
        ratios.append(gap[keep])
    return np.concatenate(places), np.concatenate(ratios)
