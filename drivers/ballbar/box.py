"""Which box is at the other end: its serial number, whether it was switched on anew, and how it reads."""

from __future__ import annotations

from abbe.drivers.ballbar import frames
from abbe.drivers.ballbar.conversation import Conversation
from abbe.drivers.ballbar.sequence import OtherPace, OtherSettings, Reads, SegmentEnd
from abbe.drivers.errors import DeviceFault, DriverError, Rebooted, Refused, SettingsChanged, WrongDevice

_TELLS_SETTINGS = 0x0101  # firmware
_RESTORE = "somebody changed the box: set it back (restore_settings), then measure this test again"


class Box:
    """What is known of the box, and must stay so.

    Parameters
    ----------
    name : str
        For errors.
    talk : Conversation
        With the box.
    serial_no : int or None
        The only box that is accepted; None: the first one that answers.
    """

    def __init__(self, name: str, talk: Conversation, serial_no: int | None) -> None:
        self.boot_id: int | None = None
        self.settings: frames.BoxSettings | None = None
        self._name, self._talk, self._serial_no = name, talk, serial_no
        self._first: frames.BoxSettings | None = None
        self._max_rate_hz = 0

    @property
    def reads(self) -> Reads | None:
        """Number of the settings and stroke, of a box that tells them."""
        return None if self.settings is None else Reads(self.settings.number, self.settings.range_nm)

    async def accept(self) -> frames.Info:
        """Ask who is there and how it reads; its boot id is the one that counts from now on.

        Raises
        ------
        WrongDevice
            Another box.
        LinkDown, ReplyTimeout, BadFrame
            The wire.
        """
        info = await self._talk.who()
        if self._serial_no not in (None, info.serial_no):
            detail = f"the box with serial number {info.serial_no} answers instead of {self._serial_no}"
            raise WrongDevice(self._name, "identify", detail, "plug in the right box, or configure this one as a device of its own")
        if info.firmware >= _TELLS_SETTINGS:
            self.settings = await self._talk.settings()
            self._first = self._first or self.settings
        self.boot_id, self._serial_no, self._max_rate_hz = info.boot_id, info.serial_no, info.max_rate_hz
        return info

    async def peek(self) -> int:
        """Ask for its boot id, and take nothing over from the answer; errors of the wire as for `accept`."""
        return (await self._talk.who()).boot_id

    async def check_boot(self) -> None:
        """Ask again; besides the errors of `accept`, ``Rebooted`` when it was switched on anew."""
        known = self.boot_id
        info = await self.accept()
        if known not in (None, info.boot_id):
            self.boot_id = known
            raise self.rebooted(f"boot id {info.boot_id:#x} instead of {known:#x}")

    def check_settings(self) -> None:
        """Raise ``SettingsChanged`` when it reads otherwise than at first, or in inches."""
        now, first = self.settings, self._first
        if now is None or first is None:
            return
        if (now.unit, now.range_nm, now.zero_nm) != (first.unit, first.range_nm, first.zero_nm):
            detail = f"the box is set to {frames.reading_text(now)} instead of {frames.reading_text(first)}"
            raise SettingsChanged(self._name, "start stream", detail, _RESTORE)
        if now.unit != frames.NANOMETRE:
            raise SettingsChanged(self._name, "start stream", "the box shows inches", "switch it to millimetres, then open it anew")

    def check_can(self, rate_hz: int, range_mm: float) -> None:
        """Raise ``Refused`` when it cannot send so fast, or clamps readings that are wanted; what it does not tell is not judged."""
        if 0 < self._max_rate_hz < rate_hz:
            detail = f"{rate_hz} Hz are wanted, the box sends at most {self._max_rate_hz}"
            raise Refused(self._name, "check", detail, "choose a lower rate")
        if self.settings is not None and self.settings.range_nm < range_mm * 1e6:
            detail = f"its range is set to +-{self.settings.range_nm * 1e-6:g} mm, needed are {range_mm:g}"
            raise Refused(self._name, "check", detail, "set a larger range at the box")

    async def restore(self) -> None:
        """Set unit, range and zero as they were at first; errors as for `accept`, and ``Refused``."""
        first = self._first
        if first is not None:
            await self._talk.command(frames.CONFIGURE, lambda tag: frames.configure_command(tag, first.unit, first.range_nm, first.zero_nm))
        await self.accept()

    def error_of(self, end: SegmentEnd) -> DriverError:
        """What a person is told when a stream cannot go on."""
        if isinstance(end, OtherSettings):
            return SettingsChanged(self._name, "stream", str(end), _RESTORE)
        if isinstance(end, OtherPace):
            return DeviceFault(
                self._name, "stream", str(end), "was the box set or restarted by somebody else? then measure this test again"
            )
        return self.rebooted(str(end))

    def rebooted(self, detail: str) -> Rebooted:
        """The error of a box that was switched on anew."""
        return Rebooted(self._name, "stream", detail, "the box restarted: call identify, then measure this test again")
