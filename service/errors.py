"""Errors of the job, with stable codes. The command line prints one line of cause and remedy and exits with 2."""

from __future__ import annotations

from collections.abc import Sequence


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
    """The database cannot be opened, is of another version, or holds what cannot be."""

    code = "STO-001"


class NotStored(StoreError):
    """The database holds nothing under the number or name that was asked for."""

    code = "STO-002"


class Unusable(AbbeError):
    """What is stored cannot be shown as it was asked for: it is not complete enough, damaged, or of another kind."""

    code = "STO-003"


class JournalChanged(StoreError):
    """The push journal is not what was written: an entry was changed, removed or swapped."""

    code = "STO-005"


class BackupRefused(AbbeError):
    """A backup cannot be made there, is damaged, or cannot be brought back over what is there. Nothing was changed."""

    code = "STO-004"


class StrokeError(AbbeError):
    """A planned path leaves the machine's strokes. Raised by the dry run, before anything moves."""

    code = "SEQ-001"


class UnsafeToMove(AbbeError):
    """An interlock forbids motion, or went away during it."""

    code = "SEQ-002"


class MeasurementFault(AbbeError):
    """A run cannot be completed: link lost, beam lost, bar out of range, feed changed."""

    code = "SEQ-003"


class Interlock(UnsafeToMove):
    """A condition that stops motion at once. Each has a code of its own; ``condition`` is its name in files and tables."""

    code = "ILK-000"
    condition = ""


class EstopPressed(Interlock):
    """The e-stop is pressed. Never goes on by itself."""

    code = "ILK-001"
    condition = "estop"


class AlarmOn(Interlock):
    """The controller has an alarm. Never goes on by itself."""

    code = "ILK-002"
    condition = "alarm"


class DoorOpen(Interlock):
    """The door is open."""

    code = "ILK-003"
    condition = "door"


class RemoteLost(Interlock):
    """The controller is not in remote mode any more."""

    code = "ILK-004"
    condition = "mode"


class DrivesOff(Interlock):
    """The drives are off, or the axes are not referenced."""

    code = "ILK-005"
    condition = "drives"


class ProgramRuns(Interlock):
    """An NC program runs: somebody else moves the machine."""

    code = "ILK-006"
    condition = "program"


class BeamLost(Interlock):
    """The laser has lost its beam or its signal is too low: its count is lost."""

    code = "ILK-007"
    condition = "beam"


class BarOutOfRange(Interlock):
    """The ball-bar is out of range or not mounted."""

    code = "ILK-008"
    condition = "bar"


class TemperatureOutside(Interlock):
    """The air is outside the window in which a measurement may run."""

    code = "ILK-009"
    condition = "temperature"


class StatusUnknown(Interlock):
    """The controller, or the instrument that is being read, has not said for too long how it is."""

    code = "ILK-010"
    condition = "status"


class SpindleTurns(Interlock):
    """The spindle turns: what is mounted on it, or in its cup, is torn off."""

    code = "ILK-011"
    condition = "spindle"


class Stopped(AbbeError):
    """A person asked to stop. What is complete stays; `abbe measure --resume` goes on."""

    code = "SEQ-004"


class Aborted(AbbeError):
    """A person asked to stop at once: the axes were stopped where they were."""

    code = "SEQ-005"


class RunInterrupted(AbbeError):
    """A run was broken off and is gone on with: what it has is kept as evidence and never averaged with what follows."""

    code = "SEQ-006"


class PreconditionsChanged(AbbeError):
    """A campaign cannot be gone on with: the controller, its table, the recipe or the machine is not what it was."""

    code = "SEQ-007"


class SetupDisturbed(AbbeError):
    """What was mounted is not where it was: it has to be mounted anew."""

    code = "SEQ-008"


class StretchDiffers(SetupDisturbed):
    """A path that was broken off reads otherwise, on the stretch that is read twice, than it did: what it has read is not gone on with."""

    code = "SEQ-009"


class MachineInUse(UnsafeToMove):
    """Another process has the machine, or is in the middle of a push into it. Nothing is wrong: it waits until that has ended."""

    code = "SEQ-010"


class DevicesNotReady(AbbeError):
    """Several devices that a measurement needs are missing, silent or not what they should be. Nothing has moved."""

    code = "SEQ-011"


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

    def __init__(self, detail: str, remedy: str = "", reasons: Sequence[str] = ()) -> None:
        super().__init__(detail, remedy)
        self.reasons = tuple(reasons) or (detail,)

    @classmethod
    def because(cls, reasons: Sequence[str], remedy: str = "nothing was written") -> TableRefused:
        """One refusal for all reasons."""
        return cls("; ".join(reasons), remedy, reasons)


class TableMismatch(AbbeError):
    """The controller does not hold the table that was sent. It was not activated."""

    code = "CMP-002"


class StillActive(AbbeError):
    """An unverified table is still active: the controller could not be switched back. Every later command tries again first."""

    code = "CMP-003"


class PushNotBegun(AbbeError):
    """A table was not brought into force: something spoke against it on the way. The old table is in force."""

    code = "CMP-004"


class TakenBack(TableRefused):
    """A table was in force for its probe, was refuted, and the old one is in force again."""

    code = "CMP-005"


class FormatRefused(AbbeError):
    """Tables do not fit what a control's format can hold (points, spacing, size, zero at the reference, kind). Nothing was written."""

    code = "TAB-001"


class TableFileError(AbbeError):
    """A control's table file is not what the control would read as a whole: file, line, what is wrong."""

    code = "TAB-002"


class TableContradicts(AbbeError):
    """Tables are not those that were expected: wrong sign, wrong unit, exchanged directions. They must not be loaded."""

    code = "TAB-003"


class CaptureFault(AbbeError):
    """Samples cannot be made safe: the disk reports an error, or there can be no segment. The run ends; what was acknowledged is kept."""

    code = "CAP-001"


class DiskFull(AbbeError):
    """No disk space is left. The reserve was released so that the run could be closed; every acknowledged sample is kept."""

    code = "CAP-002"


class CaptureConflict(AbbeError):
    """The database holds another chunk under the same number than the segment does. Nothing was overwritten."""

    code = "CAP-003"


class PasswordRefused(AbbeError):
    """A new password is one that is guessed first."""

    code = "USR-001"


class UserRefused(AbbeError):
    """No such user, role, scope or token, or what was asked would leave nobody who may manage users. Nothing was changed."""

    code = "USR-002"


class AuditBroken(AbbeError):
    """The audit was changed after it was written, or its end is missing; or a record of it cannot be written."""

    code = "AUD-001"


class SignatureRefused(AbbeError):
    """A signed compensation file is not what was signed, or not for this machine, base, limits or day. It was not taken in."""

    code = "SIG-001"


class KeyRefused(AbbeError):
    """A key cannot be read, is no Ed25519 key, or would overwrite another."""

    code = "SIG-002"


class ChannelBroken(AbbeError):
    """What came over the channel between the processes of the service is none of its messages. The process at the other end is ended."""

    code = "SRV-001"


class CoreSilent(AbbeError):
    """The core of the service does not answer its web process. What runs on the machine is not known to the page."""

    code = "SRV-002"


class KeyReused(AbbeError):
    """An Idempotency-Key came with another request than the first time. Nothing was done; a new request needs a new key."""

    code = "API-001"


class KeyInUse(AbbeError):
    """The request of this Idempotency-Key is still being worked on, or was not answered. Ask again after a minute."""

    code = "API-002"
