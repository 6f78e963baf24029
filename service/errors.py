"""Errors of the job, with stable codes. The command line prints one line of cause and remedy and exits with 2."""

from __future__ import annotations


class AbbeError(Exception):
    """Something a person has to know: what is wrong, where, and what to do.

    Parameters
    ----------
    detail : str
        What is wrong and where.
    remedy : str, optional
        What to do about it.
    """

    code = "ABB-000"

    def __init__(self, detail: str, remedy: str = "") -> None:
        self.detail = detail
        self.remedy = remedy
        super().__init__(f"{detail}" + (f" - {remedy}" if remedy else ""))


class ConfigError(AbbeError):
    """The machine file is missing, unreadable, or says something impossible."""

    code = "CFG-001"


class FileFormatError(AbbeError):
    """An exchange file is not what run-format demands: file, key, row and what was expected."""

    code = "FMT-001"


class StoreError(AbbeError):
    """The database cannot be opened, is of another version, or does not hold what was asked for."""

    code = "STO-001"


class StrokeError(AbbeError):
    """A planned path leaves the machine's strokes. Raised by the dry run, before anything moves."""

    code = "SEQ-001"


class UnsafeToMove(AbbeError):
    """An interlock forbids motion, or went away during it."""

    code = "SEQ-002"


class MeasurementFault(AbbeError):
    """A run cannot be completed: link lost, beam lost, bar out of range, feed changed."""

    code = "SEQ-003"


class NotObservable(AbbeError):
    """The data cannot carry the claim that was asked for."""

    code = "SOL-001"


class InstrumentsDisagree(AbbeError):
    """Two instruments contradict each other by more than their calibration allows: one of them, or its set-up, is wrong."""

    code = "SOL-002"


class CampaignRefused(AbbeError):
    """A run of the campaign cannot be what it says: another unit, exchanged axes, a copy, another machine. Nothing was solved."""

    code = "SOL-003"


class ModelUnknown(AbbeError):
    """The model book of a machine does not hold what was asked for, or holds what this version cannot compute."""

    code = "DIS-001"


class EffectUnknown(AbbeError):
    """The catalogue of effects has no entry of this name."""

    code = "DIS-002"


class EffectPluginBroken(AbbeError):
    """An effect of another package cannot be used. It was left out; all else works."""

    code = "DIS-003"


class ModelMovedOn(AbbeError):
    """The model of a machine has a newer version than the one that an addition was made on. Nothing was added."""

    code = "DIS-004"


class TableRefused(AbbeError):
    """A table breaks a limit (value, step, change). Nothing was written."""

    code = "CMP-001"


class TableMismatch(AbbeError):
    """The controller does not hold the table that was sent. It was not activated."""

    code = "CMP-002"


class StillActive(AbbeError):
    """An unverified table is still active: the controller could not be switched back. Every later command tries again first."""

    code = "CMP-003"
