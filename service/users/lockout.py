"""How often a password may be tried. In memory, bounded, never for ever: who waits may try again, also the last admin."""

from __future__ import annotations

import ipaddress
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

FREE = 5
FREE_OF_ADDRESS = 20
FIRST_S, LONGEST_S = 2.0, 900.0
LONGEST_OF_ACCOUNT_S = 60.0
"""All strangers together wait no longer than this for one account: guesses from ever new addresses get one try a minute, and its
owner in a new place is not kept out by the quarter of an hour."""
FORGET_S = 3600.0
MOST = 10_000


@dataclass(frozen=True, slots=True)
class Came:
    """Where a try comes from.

    Parameters
    ----------
    address : str
        Of the visitor.
    device : str
        Name of the browser, if this account has logged in with it before; empty: a stranger.
    here : bool
        The login comes from the service's own computer.
    """

    address: str
    device: str = ""
    here: bool = False


@dataclass(frozen=True, slots=True)
class _Rule:
    """What is counted under which key, how many failures are free, and how long the wait grows."""

    key: tuple[str, str]
    free: int = FREE
    longest_s: float = LONGEST_S


@dataclass(slots=True)
class _Count:
    failures: int = 0
    until_s: float = 0.0
    last_s: float = 0.0
    before: tuple[float, float] = (0.0, 0.0)
    """Both before the last try."""


class Lockout:
    """Counts failures by account and place, and by address.

    A browser or an address from which the account has logged in before, and the service's own computer, are places of their own: guesses
    from elsewhere do not delay logins there. All other places of an account also wait together, so that ever new addresses are no more
    guesses. A known browser does not even wait for others at its own address: behind a proxy all may have the same.

    Parameters
    ----------
    now_s : callable
        Monotonic seconds.
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._counts: OrderedDict[tuple[str, str], _Count] = OrderedDict()
        self._known: OrderedDict[tuple[str, str], None] = OrderedDict()

    def wait_s(self, account: str, came: Came) -> float:
        """Seconds until this account may be tried again from there; 0: now."""
        now = self._now_s()
        return max(0.0, *(self._counts[rule.key].until_s - now for rule in self._rules(account, came) if rule.key in self._counts), 0.0)

    def failed(self, account: str, came: Came) -> float:
        """Count a failure; return the seconds that have to pass before the next try."""
        now = self._now_s()
        for rule in self._rules(account, came):
            count = self._counts.setdefault(rule.key, _Count())
            count.before = (count.until_s, count.last_s)
            if now - count.last_s > FORGET_S:
                count.failures = 0
            count.failures, count.last_s = count.failures + 1, now
            if count.failures >= rule.free:
                count.until_s = now + min(FIRST_S * 2.0 ** min(count.failures - rule.free, 16), rule.longest_s)
            self._counts.move_to_end(rule.key)
        while len(self._counts) > MOST:
            self._counts.popitem(last=False)
        return self.wait_s(account, came)

    def succeeded(self, account: str, came: Came) -> None:
        """Forget the failures of this account here, and know the address. Each try was counted as a failure when it began."""
        for rule in self._rules(account, came):
            count = self._counts.get(rule.key)
            if rule.key[0]:
                self._counts.pop(rule.key, None)
            elif count is not None:
                # Of the address only this try is not counted: the owner of one account could guess at all others for ever.
                count.failures = max(count.failures - 1, 0)
                count.until_s, count.last_s = count.before
        self._known[(_fold(account), _net(came.address))] = None
        while len(self._known) > MOST:
            self._known.popitem(last=False)

    def _rules(self, account: str, came: Came) -> tuple[_Rule, ...]:
        account, net = _fold(account), _net(came.address)
        if came.device:
            return (_Rule((account, f"device {came.device}")),)
        of_address = _Rule(("", net), FREE_OF_ADDRESS)
        if came.here or (account, net) in self._known:
            return (_Rule((account, net)), of_address)
        return (_Rule((account, net)), _Rule((account, ""), longest_s=LONGEST_OF_ACCOUNT_S), of_address)


def _fold(account: str) -> str:
    # An empty name has a count of its own, not that of the address.
    return account.casefold()[:100] or "-"


def _net(address: str) -> str:
    """What one visitor has of addresses: one of IPv4, 2^64 of IPv6."""
    try:
        found = ipaddress.ip_address(address)
    except ValueError:
        return address
    if isinstance(found, ipaddress.IPv6Address) and not found.is_loopback:
        return str(found.ipv4_mapped or ipaddress.ip_network((int(found), 64), strict=False))
    return str(found)


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
