"""Passwords: argon2id, two hashes at a time; an unknown user takes the same time as a known one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cached_property
from typing import TypeVar

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerifyMismatchError

from abbe.service.errors import PasswordRefused

AT_A_TIME = 2
"""Concurrent hashes. Each takes 19 MiB and a processor for tens of milliseconds: many logins must not starve the capture."""
SHORTEST, LONGEST = 12, 256
LEAST_DIFFERENT = 5
T = TypeVar("T")
COMMON = ("password", "passwort", "qwertyuiop", "administrator", "letmein", "welcome", "1234567890", "abcdefghij", "changeme")


class Passwords:
    """Makes and checks hashes. Any thread may call; at most `AT_A_TIME` hashes run at once.

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
        """Return the hash to store."""
        return self._work(lambda: self._hasher.hash(password))

    def verify(self, kept: str | None, password: str) -> bool:
        """Whether a password matches a hash; without a hash (unknown user) it does the same work."""
        password = password[: LONGEST + 1]  # longer ones never match; do not hash them in full

        def work() -> bool:
            try:
                self._hasher.verify(kept or self._dummy_hash, password)
                return kept is not None
            except (VerifyMismatchError, InvalidHashError):
                return False

        if kept is None:
            _ = self._dummy_hash  # computed once, before the first timed check
        return self._work(work)

    @cached_property
    def _dummy_hash(self) -> str:
        return self._hasher.hash("the hash of nobody's password")

    def prepare(self) -> None:
        """Compute the dummy hash for unknown users in advance."""
        _ = self._dummy_hash

    def outdated(self, kept: str) -> bool:
        """Whether a hash was made at another cost than the present one."""
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
    """Refuse a password that is easily guessed.

    Raises
    ------
    PasswordRefused
        The password is too short or too long, has too few different characters, holds the user's name, or is a common one.
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
