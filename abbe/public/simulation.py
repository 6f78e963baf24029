"""Simulate a campaign: the readings of the instruments on a machine with known errors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from abbe.models.arrays import F1, F2, F3
from abbe.models.effects.effect import Effect, Values
from abbe.models.effects.path import Path, Places
from abbe.models.effects.self_test import probe_paths
from abbe.models.functions.motions import ErrorMotions
from abbe.models.geometry.chain import deviation_mm
from abbe.models.machine import Machine
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.domain.machine import DeviceUrls, machine_doc
from abbe.service.domain.run import Columns, Run
from abbe.service.domain.run_file import ASSUMED_MODEL, CAMPAIGN_FORMAT
from abbe.service.effects.effect_catalogue import catalogue, checked
from abbe.service.errors import EffectUnknown, Unusable
from abbe.service.runs.cases import path_of
from abbe.service.sequences.recipes.recipe import Recipe
from abbe.service.sequences.steps import CampaignPlan, MoveTo, ReadBar, ReadLaser, RecordPath, TestPlan
from abbe.service.site import Site

NAME = "simulated"
SETUP_S = 300.0
"""Time to mount a set-up, s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedInstruments:
    """Standard deviations (``*_mm``) of the random errors in a simulated campaign, and the rate of the bar's readings.

    ``bar_noise_mm``, ``laser_noise_mm``: of one reading; ``cup_mm``: of each component of a cup's position; ``bar_length_mm``: of the bar's
    calibrated length, whose error is the same for all radii. ``readings_per_s``: readings of the bar, limited to the recipe's rate.
    """

    bar_noise_mm: float = 3e-4
    laser_noise_mm: float = 1e-4
    cup_mm: float = 0.01
    bar_length_mm: float = 1e-3
    readings_per_s: float = 10.0


def simulate(
    machine: Machine,
    plan: CampaignPlan | Iterable[Recipe],
    errors: ErrorMotions,
    *,
    effects: Mapping[str, float] | None = None,
    own_effects: tuple[Effect, ...] = (),
    instruments: SimulatedInstruments | None = None,
    seed: int = 1,
) -> Campaign:
    """Simulate the runs of a plan on a machine with known errors, to first order in the errors.

    Parameters
    ----------
    plan : CampaignPlan or recipes
        E.g. ``abbe.identification(machine)``, or recipes such as ``abbe.Helix(...)``.
    errors : ErrorMotions
        Tool relative to workpiece, mm and rad.
    effects : mapping, optional
        Signed strength in the effect's unit by label, e.g. ``{"backlash:X": 6.0}`` (µm). Non-linear parameters have their typical values.
    own_effects : tuple of Effect, optional
        Additional effects beside the catalogue.
    seed : int
        Equal seeds give equal campaigns.

    Raises
    ------
    EffectUnknown, Unusable
        An effect is unknown, has no such key, cannot have this strength, or has several coefficients, so that its strength alone does not
        determine the readings.
    ConfigError
        A recipe does not fit the machine.
    """
    settings, rng = instruments or SimulatedInstruments(), np.random.default_rng(seed)
    known = catalogue()
    known = (*known, *checked(own_effects, {e.name for e in known}))
    wanted = [_effect(label, strength, known) for label, strength in (effects or {}).items()]
    tests = plan.tests if isinstance(plan, CampaignPlan) else tuple(recipe.plan(machine) for recipe in plan)
    doc = machine_doc(NAME, machine)
    name = plan.name if isinstance(plan, CampaignPlan) else NAME
    simulated = _SimulatedMachine(machine, errors, settings, rng, float(rng.normal(0.0, settings.bar_length_mm)), {})
    runs, clock_s = [], 0.0
    for test in tests:
        clock_s += SETUP_S if test.mounts else 0.0
        run = _run(name, doc, test, clock_s, settings)
        clock_s = float(run.columns.t_s[-1])
        runs.append(run.with_readings(simulated.read(path_of(run, machine, 2, 0.0), wanted)))
    head = {
        "format": CAMPAIGN_FORMAT,
        "campaign": name,
        "machine": doc,
        "current_model": {"includes": list(ASSUMED_MODEL), "errors": None},
        "instruments": {},
        "temperature_sensors": False,
    }
    return Campaign(name, Site(NAME, machine, doc, DeviceUrls()), runs, None, head)


@dataclass(frozen=True)
class _SimulatedMachine:
    """A machine with known errors, and random errors of its instruments: one for the bar length, and one for each cup's position."""

    machine: Machine
    errors: ErrorMotions
    instruments: SimulatedInstruments
    rng: np.random.Generator
    bar_mm: float
    cups: dict[str, F1]

    def read(self, path: Path, effects: Sequence[tuple[Effect, str, float]]) -> F1:
        """Return the readings of a run, mm."""
        out = path.read(self._deviation)[:, 0]
        for effect, key, coefficient in effects:
            column = effect.signal((path,), key, {p.name: p.typical for p in effect.shape})[0]
            out = out + self._moved(effect, column[:, 0], coefficient)
        if path.kind == "laser":
            noise = self.rng.normal(0.0, self.instruments.laser_noise_mm, path.n)
            return np.asarray(out + noise - (out + noise)[0])
        cup = self.cups.setdefault(path.setup, self.rng.normal(0.0, self.instruments.cup_mm, 3))
        off_sphere = np.linalg.norm(path.at.q_mm - path.centre_mm, axis=1) - path.radius_mm  # a chord lies inside its arc
        return np.asarray(off_sphere + out - path.look @ cup + self.bar_mm + self.rng.normal(0.0, self.instruments.bar_noise_mm, path.n))

    def _moved(self, effect: Effect, column: F1, coefficient: float) -> F1:
        if effect.kind == "mean":
            return np.asarray(column * coefficient)
        return np.asarray(self.rng.normal(size=column.size) * np.sqrt(np.maximum(column, 0.0)) * abs(coefficient))

    def _deviation(self, at: Places) -> F3:
        signs = np.where(at.sign < 0.0, -1.0, 1.0)
        return np.asarray(deviation_mm(self.machine, at.q_mm, self.errors.motions(at.q_mm, signs))[:, :, None])


def _effect(label: str, strength: float, known: tuple[Effect, ...]) -> tuple[Effect, str, float]:
    """Return the effect of a label, its key, and the coefficient for this strength."""
    name, _, key = label.partition(":")
    effect = next((e for e in known if e.name == name), None)
    if effect is None:
        raise EffectUnknown(f"the catalogue has no effect {name!r}", "`abbe effects` lists all")
    if key not in effect.keys:
        raise Unusable(f"{name} has no key {key!r}", f"its keys: {', '.join(effect.keys) or 'none'}")
    usual = {p.name: p.typical for p in effect.shape}
    if effect.signal(probe_paths(), key, usual)[0].shape[1] != 1:
        raise Unusable(f"{name} has several coefficients: its strength alone does not determine the readings", "simulate another effect")
    return effect, key, _coefficient(effect, strength, usual)


def _coefficient(effect: Effect, strength: float, values: Values) -> float:
    """Return the coefficient for this strength, solved numerically because the strength may be a non-linear function of it."""

    def above(coefficient: float) -> float:
        return effect.strength(np.array([coefficient]), values) / effect.per_unit - strength

    reach = next((r for r in 10.0 ** np.arange(0.0, 19.0) if above(-r) * above(r) <= 0.0), None)
    if reach is None:
        raise Unusable(f"{effect.name} cannot have the strength {strength:g} {effect.unit}", "choose another size or the other sign")
    return float(scipy.optimize.brentq(above, -reach, reach, xtol=1e-12))


def _run(campaign: str, machine: dict[str, Any], test: TestPlan, begins_s: float, instruments: SimulatedInstruments) -> Run:
    """Return a run without readings."""
    paths = [_path_rows(step, begins_s, instruments) for step in test.steps if isinstance(step, RecordPath)]
    t_s, q_mm, feed, direction = paths[0] if paths else _stationary_rows(test, begins_s)
    return Run(
        campaign=campaign,
        run_id=test.label,
        test=test.test,
        role=test.role,
        machine=machine,
        setup=test.setup.mounted(begins_s),
        columns=Columns(
            t_s=t_s,
            q_mm=q_mm,
            feed_mm_min=feed,
            direction=direction,
            deviation_mm=None,
            valid=np.ones(t_s.size, dtype=np.bool_),
            valid_stated=False,
        ),
    )


_Rows = tuple[F1, F2, F1, F1]
"""Time (n,) s, commanded positions (n, 3) mm, feed (n,) mm/min, direction (n,)."""


def _path_rows(step: RecordPath, begins_s: float, instruments: SimulatedInstruments) -> _Rows:
    """Return the rows of a polyline at constant feed, without feed-in and feed-out."""
    points = np.asarray(step.points_mm)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    first, last = step.measured or (0, len(points) - 1)
    speed = step.feed_mm_min / 60.0
    at = np.arange(arc[first], arc[last], speed / min(instruments.readings_per_s, step.rate_hz))
    q_mm = np.stack([np.interp(at, arc, points[:, k]) for k in range(3)], axis=1)
    return begins_s + at / speed, q_mm, np.full(at.size, step.feed_mm_min), np.full(at.size, float(step.direction))


def _stationary_rows(test: TestPlan, begins_s: float) -> _Rows:
    """Return the rows of a test that reads at standstill."""
    now_s, here, feed = begins_s, None, 0.0
    rows: list[tuple[float, tuple[float, ...], float, float]] = []
    for step in test.steps:
        if isinstance(step, MoveTo):
            now_s += 0.0 if here is None else 60.0 * float(np.linalg.norm(np.subtract(step.target_mm, here))) / step.feed_mm_min
            here, feed = step.target_mm, step.feed_mm_min
        elif isinstance(step, ReadLaser | ReadBar) and here is not None:
            now_s += step.settle_s
            rows.append((now_s, here, feed, float(step.direction)))
    t_s, q_mm, feeds, directions = zip(*rows, strict=True)
    return np.array(t_s), np.array(q_mm), np.array(feeds), np.array(directions)
