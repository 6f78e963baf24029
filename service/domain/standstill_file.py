"""Pydantic models of ``abbe-standstill/1``: what `abbe discover --json` writes for runs at standstill."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from abbe.service.domain.machine import FileObject

Model = Literal["absolute", "since_start"]


class StandstillRms(FileObject):
    """Rms residual over all runs, µm, each run predicted from all others: without a model, with a model without lag, with lag."""

    raw: float = Field(ge=0)
    static: float = Field(ge=0)
    response: float = Field(ge=0)


class StandstillPrediction(FileObject):
    """Predicted displacement of every reading and its standard uncertainty, mm."""

    predicted_mm: list[float]
    u_mm: list[float]


class StandstillLeftOut(StandstillPrediction):
    """A fitted run, predicted from all others."""

    run: str


class StandstillSensor(FileObject):
    """Displacement per kelvin of one sensor, at once and after the lag, µm/K, with standard uncertainties."""

    sensor: str
    at_once_um_k: float = Field(alias="at_once_um_K")
    u_at_once_um_k: float = Field(alias="u_at_once_um_K", ge=0)
    settled_um_k: float = Field(alias="settled_um_K")
    u_settled_um_k: float = Field(alias="u_settled_um_K", ge=0)


class StandstillShift(FileObject):
    """Runs in a row, first to last, that are off by more than chance explains: size and standard uncertainty, µm, and p-value."""

    model: Model
    first: str
    last: str
    um: float
    u_um: float = Field(ge=0)
    p: float = Field(ge=0, le=1)


class StandstillFile(FileObject):
    """What the temperatures explain of the displacement of a machine at standstill (ISO 230-3).

    ``runs``: fitted runs in order of time. ``covered``: share of readings within U (k = 2) in runs left out. ``model``: the one that
    predicts better; temperatures as they are, or their changes since the start of a run. ``predictions``: of runs that were not fitted.
    """

    format: Literal["abbe-standstill/1"]
    case: str
    runs: list[str]
    rms_um: StandstillRms
    covered: float = Field(ge=0, le=1)
    left_out: list[StandstillLeftOut]
    model: Model
    time_constant_s: float = Field(gt=0)
    u_time_constant_s: float = Field(ge=0)
    sensitivities: list[StandstillSensor]
    shifts: list[StandstillShift]
    predictions: dict[str, StandstillPrediction]
