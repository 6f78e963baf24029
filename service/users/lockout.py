"""Rate limits for passwords and PINs: in memory, bounded and always temporary, so that the last admin cannot be locked out."""

from __future__ import annotations

import ipaddress
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

FREE = 5
FREE_OF_ADDRESS = 20
FIRST_S, LONGEST_S = 2.0, 900.0
LONGEST_OF_ACCOUNT_S = 60.0
"""Longest wait, s, that all unknown places of an account share: an attacker with ever new addresses gets one guess a minute, and the owner
at a new place never has to wait `LONGEST_S`."""
FORGET_S = 3600.0
MOST = 10_000


@dataclass(frozen=True, slots=True)
class LoginOrigin:
    """Origin of a login attempt.

    ``address``: address of the visitor; ``device``: id of a browser with which this account has logged in before, or empty; ``local``:
    the login comes from the service's own computer; ``pin``: the attempt is a PIN, whose failures do not delay the password.
    """

    address: str
    device: str = ""
    local: bool = False
    pin: bool = False


@dataclass(frozen=True, slots=True)
class _Rule:
    """The count that an attempt belongs to (account and place), the number of failures without a wait, and the longest wait."""

    key: tuple[str, str]
    free: int = FREE
    longest_s: float = LONGEST_S


@dataclass(slots=True)
class _Count:
    failures: int = 0
    until_s: float = 0.0
    last_s: float = 0.0
    before: tuple[float, float] = (0.0, 0.0)
    """Values of ``until_s`` and ``last_s`` before the last attempt; a successful attempt restores them for its address."""


class Lockout:
    """Counts failures by account and place, and by address.

    Each known place of an account (a browser or address of an earlier login, the service's own computer) counts on its own: guesses from
    elsewhere do not delay logins there. All other places of an account also share one count, so that new addresses give no additional
    guesses. A known browser does not wait for failures at its address either, since all visitors may share one address behind a proxy.

    Parameters
    ----------
    now_s : callable
        Monotonic seconds.
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._counts: OrderedDict[tuple[str, str], _Count] = OrderedDict()
        self._known: OrderedDict[tuple[str, str], None] = OrderedDict()

    def wait_s(self, account: str, origin: LoginOrigin) -> float:
        """Seconds until the next attempt on this account from this origin; 0: now."""
        now = self._now_s()
        return max(0.0, *(self._counts[rule.key].until_s - now for rule in self._rules(account, origin) if rule.key in self._counts), 0.0)

    def failed(self, account: str, origin: LoginOrigin) -> float:
        """Count a failure; return the seconds until the next attempt."""
        now = self._now_s()
        for rule in self._rules(account, origin):
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
        return self.wait_s(account, origin)

    def succeeded(self, account: str, origin: LoginOrigin) -> None:
        """Clear the failures of this account at this place and remember the address. Call it after counting the attempt as failed."""
        for rule in self._rules(account, origin):
            count = self._counts.get(rule.key)
            if rule.key[0]:
                self._counts.pop(rule.key, None)
            elif count is not None:
                # At the address, undo this attempt only: otherwise the owner of one account could guess at all others without limit.
                count.failures = max(count.failures - 1, 0)
                count.until_s, count.last_s = count.before
        self._known[(_fold(account), _net(origin.address))] = None
        while len(self._known) > MOST:
            self._known.popitem(last=False)

    def _rules(self, account: str, origin: LoginOrigin) -> tuple[_Rule, ...]:
        account, net = _fold(account), _net(origin.address)
        if origin.device:
            return (_Rule((account, f"{'PIN at' if origin.pin else 'device'} {origin.device}")),)
        of_address = _Rule(("", net), FREE_OF_ADDRESS)
        if origin.local or (account, net) in self._known:
            return (_Rule((account, net)), of_address)
        return (_Rule((account, net)), _Rule((account, ""), longest_s=LONGEST_OF_ACCOUNT_S), of_address)


def _fold(account: str) -> str:
    # An empty name must not share the count of the address.
    return account.casefold()[:100] or "-"


def _net(address: str) -> str:
    """The network of one visitor: a single IPv4 address, a /64 of IPv6."""
    try:
        found = ipaddress.ip_address(address)
    except ValueError:
        return address
    if isinstance(found, ipaddress.IPv6Address) and not found.is_loopback:
        return str(found.ipv4_mapped or ipaddress.ip_network((int(found), 64), strict=False))
    return str(found)


class Buckets:
    """Token buckets by key: ``burst`` tokens at once, then ``rate_hz`` a second. ``now_s``: monotonic seconds."""

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
