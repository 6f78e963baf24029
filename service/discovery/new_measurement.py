"""Validate a model on a later measurement: predict it from the old runs only and compare."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from abbe.models.effects.effect import Effect
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.campaign_data.decimation import thinned
from abbe.service.discovery.discover import Thin, prepare
from abbe.service.discovery.discover_live import joined
from abbe.service.discovery.finding import noise_mm_of
from abbe.service.discovery.simulate import Simulation, simulate
from abbe.service.domain.finding import GapUm
from abbe.service.domain.model_book import ModelVersion


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
