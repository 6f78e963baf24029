"""A real database with users whose hashes are cheap, and a clock that can be turned."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from abbe.service.audit.book import AuditBook
from abbe.service.storage.store import Store
from abbe.service.users.people import Passwords, UserAccounts

PHRASE = "correct horse battery staple"


@dataclass
class Turned:
    now: datetime = field(default_factory=lambda: datetime(2026, 11, 22, 9, tzinfo=UTC))

    def utc(self) -> datetime:
        return self.now

    def monotonic_s(self) -> float:
        return self.now.timestamp()

    async def sleep(self, s: float) -> None:
        raise AssertionError("nothing sleeps here")

    def later(self, **span: float) -> None:
        self.now += timedelta(**span)


@dataclass
class World:
    store: Store
    url: str
    clock: Turned
    people: UserAccounts
    book: AuditBook


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    clock, url = Turned(), f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    with Store.open(url, utcnow=clock.utc) as store:
        yield World(store, url, clock, UserAccounts(store, clock, Passwords(memory_kib=64, passes=1)), AuditBook(store, url))
