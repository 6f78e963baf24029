"""Passwords: argon2id, two hashes at a time, the same time for a user that does not exist."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cached_property
from typing import TypeVar

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerifyMismatchError

from abbe.service.errors import PasswordRefused

AT_A_TIME = 2
"""Each hash takes 19 MiB and a processor for tens of milliseconds: many requests for one must not starve the capture."""
SHORTEST, LONGEST = 12, 256
LEAST_DIFFERENT = 5
T = TypeVar("T")
COMMON = ("password", "passwort", "qwertyuiop", "administrator", "letmein", "welcome", "1234567890", "abcdefghij", "changeme")


class Passwords:
    """Makes and checks hashes. Any thread may call; at most `AT_A_TIME` are at work.

    Parameters
    ----------
    memory_kib, passes : int
        Cost of one hash (OWASP: 19 MiB, 2 passes, 1 lane).
    """

    def __init__(self, memory_kib: int = 19_456, passes: int = 2) -> None:
        self._hasher = PasswordHasher(time_cost=passes, memory_cost=memory_kib, parallelism=1)
        self._turn = threading.BoundedSemaphore(AT_A_TIME)
        self._count = threading.Lock()
        self._busy = 0
        self.most_at_a_time = 0
        self.hashes = 0

    def hash(self, password: str) -> str:
        """Return the hash to keep."""
        return self._work(lambda: self._hasher.hash(password))

    def verify(self, kept: str | None, password: str) -> bool:
        """Tell whether a password belongs to a hash; without a hash (no such user) the work is done all the same."""
        password = password[: LONGEST + 1]  # longer ones are never right, and are not read to their end

        def work() -> bool:
            try:
                self._hasher.verify(kept or self._nobody, password)
                return kept is not None
            except (VerifyMismatchError, InvalidHashError):
                return False

        if kept is None:
            _ = self._nobody  # made once, before the first is timed
        return self._work(work)

    @cached_property
    def _nobody(self) -> str:
        return self._hasher.hash("the hash of nobody's password")

    def prepare(self) -> None:
        """Make ready what the first check of an unknown user would have to wait for."""
        _ = self._nobody

    def outdated(self, kept: str) -> bool:
        """Tell whether a hash was made at another cost than today's."""
        return self._hasher.check_needs_rehash(kept)

    def _work(self, work: Callable[[], T]) -> T:
        with self._turn:
            with self._count:
                self._busy += 1
                self.hashes += 1
                self.most_at_a_time = max(self.most_at_a_time, self._busy)
            try:
                return work()
            finally:
                with self._count:
                    self._busy -= 1


def check_new(name: str, password: str) -> None:
    """Refuse a password that is guessed first.

    Raises
    ------
    PasswordRefused
        Too short, too long, too few different characters, the user's name in it, or one that everybody tries.
    """
    low = password.lower()
    if not SHORTEST <= len(password) <= LONGEST:
        raise PasswordRefused(f"a password has {SHORTEST} to {LONGEST} characters", "a sentence of a few words does")
    if len(set(low)) < LEAST_DIFFERENT:
        raise PasswordRefused(f"the password has fewer than {LEAST_DIFFERENT} different characters", "take a sentence of a few words")
    if len(name) > 2 and name.lower() in low:
        raise PasswordRefused("the password holds the name of its user", "take another")
    if any(word in low and len(low) - len(word) < 6 for word in COMMON):
        raise PasswordRefused("the password is one that is tried first", "take a sentence of a few words")
