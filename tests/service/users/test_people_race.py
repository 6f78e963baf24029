"""Two processes change users at the same instant, on SQLite and PostgreSQL: both have looked before either writes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from abbe.service.clock import SystemClock
from abbe.service.errors import UserRefused
from abbe.service.storage.store import Store
from abbe.service.users.people import Passwords, UserAccounts
from tests.service.users.conftest import PHRASE

Pair = tuple[UserAccounts, UserAccounts]


@pytest.fixture
def pair(url: str) -> Iterator[Pair]:
    """The users of one database, as two processes have them."""
    with Store.open(url) as one, Store.open(url) as other:
        yield tuple(UserAccounts(store, SystemClock(), Passwords(memory_kib=64, passes=1)) for store in (one, other))  # type: ignore[misc]


def meeting(pair: Pair, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    """Let both wait for each other just before the method of their repositories that writes."""
    barrier = threading.Barrier(2, timeout=10)
    for people in pair:
        work: Callable[..., Any] = getattr(people._store.people, method)

        def met(*args: Any, work: Callable[..., Any] = work, **kwargs: Any) -> Any:
            barrier.wait()
            return work(*args, **kwargs)

        monkeypatch.setattr(people._store.people, method, met)


def together(*changes: Callable[[], None]) -> list[str]:
    """Do both at once; the refusals."""

    def outcome(change: Callable[[], None]) -> str:
        try:
            change()
        except UserRefused as refused:
            return refused.detail
        return ""

    with ThreadPoolExecutor(2) as pool:
        return sorted(pool.map(outcome, changes))


@pytest.mark.parametrize("kind", ["disable", "role"])
def test_two_admins_who_remove_each_other_leave_one(pair: Pair, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ana", "bob"):
        pair[0].add(name, "admin", PHRASE)
    meeting(pair, monkeypatch, "change")

    def remove(people: UserAccounts, name: str) -> None:
        people.disable(name) if kind == "disable" else people.set_role(name, "viewer")

    told = together(lambda: remove(pair[0], "ana"), lambda: remove(pair[1], "bob"))
    assert told[0] == ""
    assert told[1].endswith("is the only admin")
    assert pair[0]._store.people.active_admins() == 1


def test_one_name_added_twice_at_once_is_one_user(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    meeting(pair, monkeypatch, "add")
    told = together(*(lambda people=people: people.add("ana", "viewer", PHRASE) for people in pair))  # type: ignore[misc]
    assert told == ["", "there is a user 'ana' already"]
    assert [user.name for user in pair[0]._store.people.all()] == ["ana"]
