"""How often a password may be tried. In memory, bounded, never for ever: who waits may try again, also the last admin."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

FREE = 5
FREE_OF_ADDRESS = 20
FIRST_S, LONGEST_S = 2.0, 900.0
FORGET_S = 3600.0
MOST = 10_000


@dataclass(slots=True)
class _Count:
    failures: int = 0
    until_s: float = 0.0
    last_s: float = 0.0


class Lockout:
    """Counts failures by account, by address, and by address of an account that has logged in from it before.

    The last keeps a person working at his own computer while somebody else guesses at his account from elsewhere.

    Parameters
    ----------
    now_s : callable
        Monotonic seconds.
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._counts: OrderedDict[tuple[str, str], _Count] = OrderedDict()
        self._known: OrderedDict[tuple[str, str], None] = OrderedDict()

    def wait_s(self, account: str, address: str) -> float:
        """Seconds until this account may be tried again from this address; 0: now."""
        now = self._now_s()
        return max(0.0, *(self._counts[key].until_s - now for key, _ in self._keys(account, address) if key in self._counts), 0.0)

    def failed(self, account: str, address: str) -> float:
        """Count a failure; return the seconds that have to pass before the next try."""
        now = self._now_s()
        for key, free in self._keys(account, address):
            count = self._counts.setdefault(key, _Count())
            if now - count.last_s > FORGET_S:
                count.failures = 0
            count.failures, count.last_s = count.failures + 1, now
            if count.failures >= free:
                count.until_s = now + min(FIRST_S * 2.0 ** min(count.failures - free, 16), LONGEST_S)
            self._counts.move_to_end(key)
        while len(self._counts) > MOST:
            self._counts.popitem(last=False)
        return self.wait_s(account, address)

    def succeeded(self, account: str, address: str) -> None:
        """Forget the failures of this account here, and know the address."""
        (own, _), _ = self._keys(account, address)
        self._counts.pop(own, None)  # the count of the address stays: whoever has one account could guess at all others for ever
        self._known[(_fold(account), address)] = None
        while len(self._known) > MOST:
            self._known.popitem(last=False)

    def _keys(self, account: str, address: str) -> tuple[tuple[tuple[str, str], int], ...]:
        account = _fold(account)
        here = address if (account, address) in self._known else ""
        return (((account, here), FREE), (("", address), FREE_OF_ADDRESS))


def _fold(account: str) -> str:
    return account.casefold()[:100]


class Buckets:
    """Token buckets: so many at once, so many a second after that, for each key.

    Parameters
    ----------
    rate_hz, burst : float
        Tokens a second; most at once.
    now_s : callable
        Monotonic seconds.
    """

    def __init__(self, rate_hz: float, burst: float, now_s: Callable[[], float]) -> None:
        self._rate, self._burst, self._now_s = rate_hz, burst, now_s
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, key: str) -> bool:
        """Take a token; False if there is none."""
        now = self._now_s()
        left, at = self._left.get(key, (self._burst, now))
        left = min(self._burst, left + (now - at) * self._rate)
        self._left[key] = (left - 1.0 if left >= 1.0 else left, now)
        self._left.move_to_end(key)
        while len(self._left) > MOST:
            self._left.popitem(last=False)
        return left >= 1.0
