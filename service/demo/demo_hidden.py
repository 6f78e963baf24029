"""The demonstration of a discovery on a simulated machine that may hide an effect unknown to Abbe.

measure -> search -> model book -> new measurement -> test of the model -> tables or remedy; the simulator's sealed truth is read last.
"""

from __future__ import annotations

import asyncio
import threading
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from abbe.models.effects.effect import Effect
from abbe.service.campaign_data.campaign_folder import Campaign, from_store
from abbe.service.campaign_data.decimation import picked, thinned
from abbe.service.campaigns.measure import measure
from abbe.service.clock import Clock, SystemClock
from abbe.service.compensation.commission import commission
from abbe.service.compensation.correct import correct
from abbe.service.compensation.gate import PushContext
from abbe.service.compensation.proposals import load_runs
from abbe.service.demo.demo import DemoRun, bar_rate_hz, demo_site, write_machine_file
from abbe.service.demo.simulator_process import HiddenTruth, running_simulators, sealed_truth
from abbe.service.devices.session import Session, open_session
from abbe.service.discovery.discover import DiscoveryJob, DiscoveryJournal, Thin, discover, prepare, search
from abbe.service.discovery.discover_live import joined
from abbe.service.discovery.discovery_answer import location_doc
from abbe.service.discovery.discovery_store import journal_of
from abbe.service.discovery.discovery_text import book_lines, effect_lines, next_of, verdict_of
from abbe.service.discovery.finding import noise_mm_of
from abbe.service.discovery.simulate import Simulation, simulate
from abbe.service.domain.finding import Finding, GapUm
from abbe.service.domain.model_book import ModelVersion
from abbe.service.domain.progress import Progress, ProgressSink
from abbe.service.domain.run import Run
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.effects.model_book import current
from abbe.service.errors import NotObservable, TableRefused
from abbe.service.rendering.numbers import plain
from abbe.service.sequences.recipes.campaigns import BACK, discovery_campaign, new_measurement
from abbe.service.storage.store import Store


@dataclass(frozen=True)
class NewMeasurement:
    """The gap on all new runs together and by run, without ("before") and with ("after") the finding in the model."""

    gap: GapUm
    runs: dict[str, GapUm]


def validate_on(
    old: Campaign, new: Campaign, effects: tuple[Effect, ...], model: ModelVersion | None, *, thin: Thin = thinned
) -> NewMeasurement:
    """Predict a new campaign from an old one and the model book, and compare.

    Parameters
    ----------
    old : Campaign
        Campaign of the discovery. Only its identify runs are fitted.
    new : Campaign
        Measured later while the controller's clock kept running. Only its own set-up values are fitted: the zero of every laser run, and
        the cup position of a new set-up.
    model : ModelVersion, optional
        Version of the model book with the finding. None: nothing was found, and before and after are equal.

    Raises
    ------
    CampaignRefused
        The data of a new run contradict its description, or it is a copy of an old one.
    """
    fresh = replace(new, runs=[replace(run, role="holdout") for run in new.runs])
    both = replace(joined(old, fresh), name=old.name)  # under the old name: thermal and instrument effects of that session still apply
    plain = simulate(prepare(both, effects, thin=thin))
    known = plain if model is None else simulate(prepare(both, effects, model, thin=thin))
    labels = [run.run_id for run in new.runs]
    kinds = {run.run_id: "bar" if run.is_bar else "laser" for run in new.runs}
    runs = {label: _gap([label], plain, known, kinds) for label in labels}
    return NewMeasurement(_gap(labels, plain, known, kinds), runs)


def _gap(labels: list[str], plain: Simulation, known: Simulation, kinds: dict[str, str]) -> GapUm:
    floor = np.concatenate([np.full(known.residual_mm[k].size, noise_mm_of(known.noise_mm, kinds[k])) for k in labels])
    before, after = ([simulation.residual_mm[k] for k in labels] for simulation in (plain, known))
    return GapUm(before_um=_rms_um(before), after_um=_rms_um(after), floor_um=_rms_um([floor]))


def _rms_um(parts: list[np.ndarray]) -> float:
    values = np.concatenate(parts)
    return 1e3 * float(np.sqrt(np.nanmean(values**2)))


MOST = 5000
"""Number of ball-bar readings in the search: one every 2 to 6 mm of path. All readings would take four times as long."""
CAMPAIGN, ANEW = "discover", "anew"


@dataclass(kw_only=True)
class HiddenDemo(DemoRun):
    """Results of the demonstration, in the order in which they arise.

    ``refused``: why a table was not written; ``hidden``: what the machine really hides, known at the end.
    """

    finding: Finding = field(default_factory=lambda: Finding(verdict="unknown"))
    job: DiscoveryJob | None = None
    journal: DiscoveryJournal | None = None
    anew: NewMeasurement | None = None
    refused: str = ""
    hidden: HiddenTruth | None = None


async def run_hidden_demo(
    simulator_args: list[str], speed: float, folder: Path, progress: ProgressSink, *, tables: bool = True, clock: Clock | None = None
) -> HiddenDemo:
    """Run a discovery on a simulated machine over real connections.

    Parameters
    ----------
    simulator_args : list of str
        Arguments of the simulators: ``--hidden SEED``, or a scenario file, which is not read here.
    folder : Path
        Receives database and machine file.
    tables : bool
        Whether to write and verify tables if the gap was explained.

    Raises
    ------
    AbbeError, DriverError
        The demonstration failed; the error names cause and remedy. The simulators are stopped in any case.
    """
    clock = clock or SystemClock()
    start = clock.monotonic_s()
    async with running_simulators([*simulator_args, "--speed", f"{speed:g}", "--link-dir", str(folder)]) as simulator:
        site = demo_site(simulator)
        write_machine_file(site, folder)
        result = HiddenDemo(site=site, folder=folder, started_utc=clock.utc().isoformat(timespec="seconds"))
        store = await asyncio.to_thread(Store.open, f"sqlite:///{folder / 'abbe.sqlite3'}")
        try:
            async with open_session(site.urls) as session:
                await _job(session, store, result, progress, speed, tables=tables)
        finally:
            store.close()
    progress(Progress("truth", 0.0, 1.0, None, "opening the simulator's sealed truth"))
    result.hidden = (await sealed_truth(simulator_args, None)).hidden
    result.duration_s = clock.monotonic_s() - start
    return result


def few(runs: list[Run]) -> list[Run]:
    """Thin the runs to about `MOST` ball-bar readings in all."""
    return picked(runs, MOST)


async def _job(session: Session, store: Store, result: HiddenDemo, progress: ProgressSink, speed: float, *, tables: bool) -> None:
    site, rate = result.site, bar_rate_hz(2.0 * speed)  # half the usual rate: hidden effects need computing time
    await measure(session, store, site, discovery_campaign(site.machine, rate_hz=rate, name=CAMPAIGN), progress=progress)
    old = await asyncio.to_thread(from_store, store, CAMPAIGN)
    job = await asyncio.to_thread(prepare, old, catalogue(), current(store, site.name), thin=few)
    journal = await asyncio.to_thread(journal_of, store, job)
    result.job, result.journal = job, journal
    result.finding = await _search(job, journal, progress)
    ids = await measure(session, store, site, new_measurement(site.machine, rate_hz=rate, name=ANEW), progress=progress)
    progress(Progress("prediction", 0.0, 1.0, None, "comparing the new measurement with the model"))
    new = await asyncio.to_thread(from_store, store, ANEW)
    model = current(store, site.name)
    result.anew = await asyncio.to_thread(validate_on, old, new, job.effects, model, thin=few)
    if not tables or model is None:
        return
    try:
        await commission(session, store, site, progress=progress)
        before = [run for run in await load_runs(store, ids) if run.run_id != BACK]  # the runs of the verification
        result.correction = await correct(PushContext(session, store, site, progress, rate_hz=rate), CAMPAIGN, before)
    except (TableRefused, NotObservable) as error:
        result.refused = str(error)


async def _search(job: DiscoveryJob, journal: DiscoveryJournal, progress: ProgressSink) -> Finding:
    """Search in a thread. After a cancellation the thread ends at its next report of progress."""
    stopped = threading.Event()

    def checked_progress(p: Progress) -> None:
        if stopped.is_set():
            raise InterruptedError("the search was stopped")
        progress(p)

    try:
        return await asyncio.to_thread(discover, job, journal, search, checked_progress)
    except asyncio.CancelledError:
        stopped.set()
        raise


FORMAT = "abbe-hidden-demo/1"


def summary_lines(result: HiddenDemo) -> list[str]:
    """Return the results line by line, in the order in which they arose."""
    finding = result.finding
    _, word, text = verdict_of(finding)
    lines = [f"measured: {len(finding.runs)} runs, {sum(r.readings for r in finding.runs.values())} readings"]
    lines += [f"{word}. {text}"]
    lines += [f"{role} runs: {_gap_text(g)}" for role, g in finding.gaps.items()]
    for effect in finding.effects:
        lines += effect_lines(effect)
    lines += next_of(finding) + _model(result) + _anew(result) + _tables(result)
    return [*lines, *truth_lines(result)]


def _gap_text(gap: GapUm) -> str:
    return f"gap {plain(gap.before_um)} -> {plain(gap.after_um)} µm rms (noise alone: {plain(gap.floor_um)} µm)"


def _model(result: HiddenDemo) -> list[str]:
    version = None if result.journal is None else result.journal.version
    if version is not None:
        return [f"model book: version {version} of {result.site.name} contains it now"]
    return book_lines(result.finding) or ["model book: unchanged, since no effect was proved for it"]


def _anew(result: HiddenDemo) -> list[str]:
    if result.anew is None:
        return []
    runs = [f"  {label}: {_gap_text(r)}" for label, r in result.anew.runs.items()]
    return [f"new measurement at positions that no fit has used: {_gap_text(result.anew.gap)}", *runs]


def _tables(result: HiddenDemo) -> list[str]:
    c = result.correction
    if c is None:
        return [f"tables: none written: {result.refused}"] if result.refused else []
    kept = "kept" if c.decision.keep else "rolled back"
    lines = [f"tables for the 21 error motions: {kept}; {c.decision.text}"]
    return lines + [f"not in the tables: {line}" for line in c.not_for_tables]


def judged(result: HiddenDemo) -> tuple[bool, str]:
    """Return whether the answer was right, and a sentence about it.

    Right answers: exactly the hidden name and key; ``none`` if nothing is hidden; ``unknown`` if the catalogue lacks the hidden effect.
    """
    finding, secret = result.finding, result.hidden
    named = [e.label for e in finding.effects]
    if secret is None:
        right = finding.verdict == "none"
        return right, "nothing was hidden" + ("" if right else f"; the answer was {', '.join(named) or finding.verdict}")
    label = secret.label
    if secret.name not in {e.name for e in catalogue()}:
        right = finding.verdict == "unknown" and not named
        return right, f"the hidden effect was {label}, which the catalogue lacks; the answer was {', '.join([finding.verdict, *named])}"
    right = finding.verdict == "named" and named == [label]
    also = [n for n in named if n != label]
    if label in named and also:
        return False, f"the hidden effect was {label}; it was named, but so was {', '.join(also)}, which is not in the machine"
    return right, f"the hidden effect was {label}; the answer was {', '.join(named) or finding.verdict}"


def truth_lines(result: HiddenDemo) -> list[str]:
    """Return the lines that compare the answer with the sealed truth."""
    right, text = judged(result)
    lines = [f"sealed truth: {text}. {'RIGHT' if right else 'WRONG'}."]
    secret = result.hidden
    if secret is not None:
        values = ", ".join(f"{k} {v:g}" for k, v in secret.parameters.items())
        bent = "; its shape deviates from the formula in the catalogue" if secret.wild else ""
        lines.append(f"  its true parameters: {values}{bent}")
    return lines


def hidden_json(result: HiddenDemo) -> dict[str, Any]:
    """Return the JSON output of `abbe demo --hidden SEED --json`."""
    finding, c = result.finding, result.correction
    fields = ("label", "name", "key", "strength", "u_strength", "unit", "remedy", "remedy_text")
    right, text = judged(result)
    doc: dict[str, Any] = {
        "format": FORMAT,
        "verdict": finding.verdict,
        "effects": [{k: getattr(e, k) for k in fields} for e in finding.effects],
        "where": location_doc(finding.location),
        "gaps": {role: asdict(gap) for role, gap in finding.gaps.items()},
        "model_version": None if result.journal is None else result.journal.version,
        "anew": None if result.anew is None else asdict(result.anew),
        "tables": None if c is None else {"kept": c.decision.keep, "verdict": c.decision.text, "stays": list(c.not_for_tables)},
        "tables_refused": result.refused or None,
        "hidden": None if result.hidden is None else asdict(result.hidden),
        "right": right,
        "judgement": text,
    }
    return doc | {"duration_s": round(result.duration_s, 1)}
