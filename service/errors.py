"""Errors of the service, with stable codes. The command line prints one line of cause and remedy and exits with 2.

The functions turn validation errors into text: where the mistake is, what was expected, what the author probably meant.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


class AbbeError(Exception):
    """An error that a person has to know: what is wrong, where, and what to do.

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
    """The machine file is missing, unreadable, or has an impossible value."""

    code = "CFG-001"


class FileFormatError(AbbeError):
    """An exchange file violates its format (docs/schemas, docs/reference); the message names file, key, row and the expected value."""

    code = "FMT-001"


class StoreError(AbbeError):
    """The database cannot be opened, has another version, or holds impossible data."""

    code = "STO-001"


class NotStored(StoreError):
    """The database has no entry with this number or name."""

    code = "STO-002"


class Unusable(AbbeError):
    """A stored entry cannot be shown as requested: it is incomplete, damaged, or of another kind."""

    code = "STO-003"


class JournalChanged(StoreError):
    """The push journal was changed after it was written: an entry was edited, removed or swapped."""

    code = "STO-005"


class BackupRefused(AbbeError):
    """A backup cannot be written to this place, is damaged, or cannot replace the existing data. Nothing was changed."""

    code = "STO-004"


class StrokeError(AbbeError):
    """A planned path leaves the machine's strokes. Raised by the dry run, before anything moves."""

    code = "SEQ-001"


class UnsafeToMove(AbbeError):
    """An interlock forbids motion, or tripped during motion."""

    code = "SEQ-002"


class MeasurementFault(AbbeError):
    """A run cannot be completed: link lost, beam lost, bar out of range, feed changed."""

    code = "SEQ-003"


class Interlock(UnsafeToMove):
    """A condition that stops motion at once. Each has its own code; ``condition`` is its name in files and tables."""

    code = "ILK-000"
    condition = ""


class EstopPressed(Interlock):
    """The e-stop is pressed. The measurement never resumes by itself."""

    code = "ILK-001"
    condition = "estop"


class AlarmOn(Interlock):
    """The controller has an alarm. The measurement never resumes by itself."""

    code = "ILK-002"
    condition = "alarm"


class DoorOpen(Interlock):
    """The door is open."""

    code = "ILK-003"
    condition = "door"


class RemoteLost(Interlock):
    """The controller is no longer in remote mode."""

    code = "ILK-004"
    condition = "mode"


class DrivesOff(Interlock):
    """The drives are off, or the axes are not referenced."""

    code = "ILK-005"
    condition = "drives"


class ProgramRuns(Interlock):
    """An NC program runs and moves the machine."""

    code = "ILK-006"
    condition = "program"


class BeamLost(Interlock):
    """The laser has lost its beam, or its signal is too low: its count is invalid."""

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
    """The controller, or the instrument being read, has not reported its status for too long."""

    code = "ILK-010"
    condition = "status"


class SpindleTurns(Interlock):
    """The spindle turns and would tear off the mounted instrument."""

    code = "ILK-011"
    condition = "spindle"


class Stopped(AbbeError):
    """A person stopped the measurement. Completed runs are kept; `abbe measure --resume` continues."""

    code = "SEQ-004"


class Aborted(AbbeError):
    """A person aborted the measurement: the axes stopped where they were."""

    code = "SEQ-005"


class RunInterrupted(AbbeError):
    """A run was interrupted and its campaign resumed: its data are kept as evidence and never averaged with later data."""

    code = "SEQ-006"


class PreconditionsChanged(AbbeError):
    """A campaign cannot be resumed: the controller, its table, the recipe or the machine has changed."""

    code = "SEQ-007"


class SetupDisturbed(AbbeError):
    """A mounted instrument, stylus or target has moved or changed: it must be mounted again."""

    code = "SEQ-008"


class StretchDiffers(SetupDisturbed):
    """The part of an interrupted path that is read twice gives different readings: the path cannot be resumed."""

    code = "SEQ-009"


class MachineInUse(UnsafeToMove):
    """Another process uses the machine, or pushes a table into it. This is not a fault: wait until that process has finished."""

    code = "SEQ-010"


class DevicesNotReady(AbbeError):
    """Several devices that the measurement needs are missing, silent or of the wrong kind. Nothing has moved."""

    code = "SEQ-011"


class ProbeFault(MeasurementFault):
    """The touch probe cannot measure a feature. The stylus was withdrawn first, or backed off; earlier features are kept."""

    code = "PRB-000"


class ProbeNotReady(ProbeFault):
    """No touch probe is fitted and ready, or its stylus is deflected before a touch."""

    code = "PRB-001"


class MissedContact(ProbeFault):
    """The probe reached the end of a touch without tripping."""

    code = "PRB-002"


class Obstructed(ProbeFault):
    """The probe tripped twice on a way that should be free: the artefact is not in the stated pose."""

    code = "PRB-003"


class FalseTrips(ProbeFault):
    """The probe trips at places that do not repeat."""

    code = "PRB-004"


class ProbeUncalibrated(ProbeFault):
    """A feature's radius shows that the stylus is not the stated one, or not qualified."""

    code = "PRB-005"


class NotObservable(AbbeError):
    """The data do not determine the requested quantity."""

    code = "SOL-001"


class InstrumentsDisagree(AbbeError):
    """Two instruments differ by more than their calibration allows: one of them, or its set-up, is wrong."""

    code = "SOL-002"


class CampaignRefused(AbbeError):
    """A run of the campaign contradicts its description: another unit, exchanged axes, a copy, another machine. Nothing was solved."""

    code = "SOL-003"


class ModelUnknown(AbbeError):
    """The model book of a machine has no such version or effect, or has one that this version of Abbe cannot compute."""

    code = "DIS-001"


class EffectUnknown(AbbeError):
    """The catalogue of effects has no entry with this name."""

    code = "DIS-002"


class EffectPluginBroken(AbbeError):
    """An effect from a plug-in package cannot be used. It was left out; everything else works."""

    code = "DIS-003"


class ModelMovedOn(AbbeError):
    """The machine's model has a newer version than the one that the addition is based on. Nothing was added."""

    code = "DIS-004"


class TableRefused(AbbeError):
    """A table exceeds a limit (value, step, change). Nothing was written."""

    code = "CMP-001"

    def __init__(self, detail: str, remedy: str = "", reasons: Sequence[str] = ()) -> None:
        super().__init__(detail, remedy)
        self.reasons = tuple(reasons) or (detail,)

    @classmethod
    def because(cls, reasons: Sequence[str], remedy: str = "nothing was written") -> TableRefused:
        """Return one refusal with all reasons."""
        return cls("; ".join(reasons), remedy, reasons)


class TableMismatch(AbbeError):
    """The controller's table differs from the one that was sent. It was not activated."""

    code = "CMP-002"


class StillActive(AbbeError):
    """An unverified table is still active: the controller could not be switched back. Every later command first tries again."""

    code = "CMP-003"


class PushNotBegun(AbbeError):
    """A table was not activated: a condition of the push was not met. The old table is in force."""

    code = "CMP-004"


class TakenBack(TableRefused):
    """A new table was active for the test of its signs, and failed it; the old table is in force again."""

    code = "CMP-005"


class FormatRefused(AbbeError):
    """The tables do not fit the control's format (points, spacing, size, zero at the reference, kind). Nothing was written."""

    code = "TAB-001"


class TableFileError(AbbeError):
    """A control could not read this table file completely, or the file is for another control; the message names file and line of a
    mistake."""

    code = "TAB-002"


class TableContradicts(AbbeError):
    """The tables differ from the expected ones: wrong sign, wrong unit, exchanged directions. They must not be loaded."""

    code = "TAB-003"


class CaptureFault(AbbeError):
    """Samples cannot be saved: the disk reports an error, or no segment can be created. The run ends; acknowledged samples are kept."""

    code = "CAP-001"


class DiskFull(AbbeError):
    """No disk space is left. The reserve was released to close the run; every acknowledged sample is kept."""

    code = "CAP-002"


class CaptureConflict(AbbeError):
    """The database has other samples under the number of a chunk in a capture segment. Nothing was overwritten."""

    code = "CAP-003"


class AlarmRefused(AbbeError):
    """This acknowledgement or shelving of an alarm is not allowed. Nothing was recorded."""

    code = "ALM-010"


class PasswordRefused(AbbeError):
    """The new password is too easy to guess."""

    code = "USR-001"


class UserRefused(AbbeError):
    """The user, role, scope or token does not exist, or the change would leave no one who can manage users. Nothing was changed."""

    code = "USR-002"


class AuditBroken(AbbeError):
    """The audit was changed after it was written, or its end is missing, or a record cannot be written."""

    code = "AUD-001"


class SignatureRefused(AbbeError):
    """A signed compensation file was changed, or is for another machine, base, limits or day. It was not imported."""

    code = "SIG-001"


class KeyRefused(AbbeError):
    """A key cannot be read, is not an Ed25519 key, or would overwrite another."""

    code = "SIG-002"


class ChannelBroken(AbbeError):
    """The service's processes exchanged an invalid message. The process at the other end is ended."""

    code = "SRV-001"


class CoreUnavailable(AbbeError):
    """The service's core does not answer its web process. The page does not know what runs on the machine."""

    code = "SRV-002"


class KeyReused(AbbeError):
    """An Idempotency-Key was used again with a different request. Nothing was done; a new request needs a new key."""

    code = "API-001"


class KeyInUse(AbbeError):
    """The request with this Idempotency-Key is still running, or its result is unknown. Ask again after a minute."""

    code = "API-002"


def location_text(location: tuple[int | str, ...]) -> str:
    """Return the location of an error as text, e.g. ``schedule[1].cron``. ``location`` counts indices from 0, the text from 1."""
    text = ""
    for part in location:
        text += f"[{part + 1}]" if isinstance(part, int) else f".{part}" if text else part
    return text


@dataclass(frozen=True, slots=True)
class Mistake:
    """A mistake found by pydantic; ``place``: keys and indices down to it; ``kind``: pydantic's type of error; ``value``: what is there."""

    place: tuple[int | str, ...]
    kind: str
    message: str
    value: Any = None

    @property
    def unknown_key(self) -> bool:
        """Whether a model or a dataclass has no such key."""
        return self.kind in ("extra_forbidden", "unexpected_keyword_argument")

    @property
    def path(self) -> str:
        """The place as a dotted path; each part is cut to 100 characters."""
        return ".".join(str(part)[:100] for part in self.place)

    @property
    def expected(self) -> str:
        """One line: the expected and the found value."""
        plain = self.message.removeprefix("Value error, ").partition(", unable to parse string")[0]
        plain = plain.replace("Input should be a valid", "expected a").replace("Input should be", "expected")
        for noun in ("integer", "array", "object"):
            plain = plain.replace(f"expected a {noun}", f"expected an {noun}")
        if self.kind == "value_error":
            return plain  # our own validators already include the value
        return f"{plain}, got {short_repr(self.value)}"


def mistakes(errors: Iterable[ErrorDetails]) -> list[Mistake]:
    """Parse the errors of a pydantic ``ValidationError``; errors about unknown keys come first.

    A mistyped key is both unknown and missing: naming the unknown one helps more.
    """
    found = [Mistake(one["loc"], one["type"], one["msg"], one.get("input")) for one in errors]
    return sorted(found, key=lambda one: not one.unknown_key)


def and_more(errors: Sequence[Mistake]) -> str:
    """Return text that counts the mistakes after the first; empty if there are none."""
    return f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""


def nearest(key: str, valid: Iterable[str]) -> str:
    """Return a hint for an unknown key: the nearest valid key, or all of them."""
    keys = sorted(valid)
    close = difflib.get_close_matches(key.lower(), keys, n=1, cutoff=0.5) or [one for one in keys if one.lower() == key.lower()]
    return f"did you mean {close[0]!r}?" if close else f"valid keys here: {', '.join(keys)}"


def short_repr(value: Any) -> str:
    """Return a value's ``repr`` on one line, at most 60 characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."
