"""Report of a stored discovery: what the model lacks, how large it is, what proves it, what else it could be."""

from __future__ import annotations

from abbe.service.campaign_data.campaign_folder import from_store
from abbe.service.campaign_data.decimation import thinned
from abbe.service.discovery.discovery_store import stored_steps
from abbe.service.discovery.discovery_words import book_lines, rival_lines, unit
from abbe.service.domain.finding import Finding
from abbe.service.errors import StoreError
from abbe.service.rendering.discovery_model import DiscoveryPage
from abbe.service.rendering.document import Document, Figure, Picture, Section, Sign, TextTable
from abbe.service.rendering.numbers import NOT_AVAILABLE, plain
from abbe.service.rendering.plots.gap import gap_bars, place_plot, trace_plot
from abbe.service.report import report_parts as parts
from abbe.service.report.blocks import picture_section
from abbe.service.report.discovery_pages import discovery_page
from abbe.service.report.report_parts import Rules
from abbe.service.storage.store import Store

DECIDED = "How it was decided"
SIGNS: dict[str, Sign] = {"ok": "ok", "open": "open", "bad": "bad"}


def discovery_report(store: Store, number: int, rules: Rules) -> Document:
    """A discovery as it was stored; nothing is searched again.

    Raises
    ------
    StoreError
        There is no such discovery, or it has not found anything yet.
    """
    record = store.discoveries.get(number)
    steps = stored_steps(store, number)
    finding = next((step.finding for step in steps if step.finding is not None), None)
    start = steps[0].start if steps else None
    if finding is None or start is None:
        raise StoreError(f"discovery {number} has not ended", "give the same abbe discover command again: it goes on there")
    name = next(c.name for c in store.campaigns.all() if c.id == record.campaign_id)
    campaign = from_store(store, name)
    states = [(step.state, step.why) for step in steps]
    page = discovery_page(
        finding, thinned(campaign.runs), {}, {"title": "", "flags": list(start.flags), "states": states, "provenance": {}}
    )
    condition, remarks = parts.conditions(campaign.runs, rules)
    sign, word, text = page.verdict
    return Document(
        kind="discovery",
        title=f"Discovery {number}: what the simulation of {campaign.site.name} lacks",
        about=parts.machine_facts(campaign.site.doc)
        | {"Campaign": name, "Begun": record.created_utc, "Ended": store.discoveries.steps(number)[-1].utc, "State": steps[-1].state}
        | {"Present model": ", ".join(start.present_model)},
        verdict=(SIGNS[sign], word, text),
        figures=_figures(finding),
        instruments=parts.instruments(campaign.runs, campaign.doc, rules),
        conditions=condition,
        not_observable=_open(finding, page),
        remarks=[*start.flags, *book_lines(finding), *remarks],
        statements=["U of a named effect is that of its refit together with everything else that these runs leave free."],
        provenance=parts.provenance(parts.data_digest(campaign.runs), dict(start.source.versions)) | {"Search (SHA-256)": record.digest},
        appendix=[*picture_section(_pictures(page)), *_tables(page)],
    )


def _figures(finding: Finding) -> list[Figure]:
    out = []
    for e in finding.effects:
        group = f"Effect: {e.words}"
        out.append(Figure(group, e.label, e.title, e.strength, e.u_strength, unit(e.unit), e.source))
        out += [Figure(group, n, n.replace("_", " "), p.value, p.u, unit(p.unit)) for n, p in e.parameters.items()]
    for role, gap in finding.gaps.items():
        group = f"Gap of the {role} runs"
        out.append(Figure(group, "before", "measured minus simulated, rms", gap.before_um, None, "µm"))
        out.append(Figure(group, "after", "the same with what was found", gap.after_um, None, "µm"))
        out.append(Figure(group, "floor", "noise", gap.floor_um, None, "µm"))
    return out


def _open(finding: Finding, page: DiscoveryPage) -> list[str]:
    out = ["these runs cannot tell it from: " + ", ".join(finding.confounded_with)] if finding.confounded_with else []
    out += [f"{e.words} could also be: {line}" for e in finding.effects for line in rival_lines(e)]
    return out + list(page.next_test)


def _tables(page: DiscoveryPage) -> list[Section]:
    runs = [(r.label, r.test, r.role, str(r.readings), plain(r.before_um), plain(r.after_um), plain(r.floor_um)) for r in page.runs]
    out = [Section("Runs", [TextTable(("Run", "Test", "Role", "Readings", "Before, µm", "After, µm", "Noise, µm"), runs)])]
    out.append(Section(DECIDED, [TextTable(("State", "Why"), page.states)]))
    if page.changed:
        out.append(
            Section(
                "What has changed", [TextTable(("Compared with the solution from before",), [(line.strip(),) for line in page.changed])]
            )
        )
    if page.effects:
        cards = [(c.name, c.where or NOT_AVAILABLE, c.do) for c in page.effects]
        out.append(Section("What to do", [TextTable(("Effect", "Where", "What to do at the machine"), cards)]))
    if page.rejected:
        out.append(Section("Looked at and rejected", [TextTable(("Effect", "Why"), page.rejected)]))
    return out


def _pictures(page: DiscoveryPage) -> list[Picture]:
    out = [Picture("Gap of every run before and after, against its noise.", [gap_bars(page.runs)], "wide")] if page.runs else []
    for i, t in enumerate(page.traces):
        out.append(Picture(f"Run {t.label} against {t.x_label}: {t.why}.", [trace_plot(t, key=f"trace-{i}")], "wide"))
    for i, p in enumerate(page.places):
        words = f"Where the gap lives, {p.x_axis}{p.y_axis}: rms over the noise."
        out.append(Picture(words, [place_plot(p, key=f"place-{i}")]))
    return out
