"""Users, roles, sessions, tokens: what holds, what ends, what is never kept."""

from __future__ import annotations

import statistics
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from abbe.service.domain.people import ALLOWED, Permission, Role
from abbe.service.errors import PasswordRefused, UserRefused
from abbe.service.users.lockout import MOST, Buckets, Lockout, LoginOrigin
from abbe.service.users.people import ANONYMOUS, AT_A_TIME, MOST_WRONG_PINS, Passwords, UserAccounts, digest_of
from tests.service.users.conftest import PHRASE, World


def test_the_table_of_rights_is_that_of_the_specification() -> None:
    assert set(ALLOWED) == set(Role)
    assert all(Permission.READ in rights for rights in ALLOWED.values())
    who_may = {p: {r for r in Role if p in ALLOWED[r]} for p in Permission}
    assert who_may[Permission.USERS] == who_may[Permission.CONFIGURE] == {Role.ADMIN}
    assert who_may[Permission.APPROVE] == {Role.APPROVER}
    assert who_may[Permission.PROPOSE] == who_may[Permission.SOLVE] == {Role.METROLOGIST}
    assert who_may[Permission.MEASURE] == {Role.OPERATOR, Role.METROLOGIST}
    # Nobody approves what he proposed: no role has both.
    assert not who_may[Permission.APPROVE] & who_may[Permission.PROPOSE]


def test_a_password_is_kept_as_argon2id_and_nowhere_in_clear(world: World, tmp_path: Path) -> None:
    world.people.add("ana", "operator", PHRASE)
    token = world.people.add_token("ana", "ci", ["read"], 1)
    secret = world.people.begin(world.people.get("ana"))
    assert world.people.get("ana").password.startswith("$argon2id$")
    for file in tmp_path.iterdir():
        content = file.read_bytes()
        for canary in (PHRASE, token, token.split("_", 2)[2], secret):
            assert canary.encode() not in content, file


def test_the_default_cost_is_that_of_the_specification() -> None:
    assert Passwords().hash(PHRASE).startswith("$argon2id$v=19$m=19456,t=2,p=1$")


@pytest.mark.parametrize("password", ["short", "aaaaaaaaaaaaaa", "ana-ana-longer-12", "password1234", "abababababababab", "x" * 300])
def test_a_weak_password_is_refused(world: World, password: str) -> None:
    with pytest.raises(PasswordRefused):
        world.people.add("ana", "viewer", password)
    assert world.store.people.all() == []


@pytest.mark.parametrize("name", ["", "a b", "<b>", "x" * 65, "-a", "a\n", "ünal"])
def test_a_name_is_plain(world: World, name: str) -> None:
    with pytest.raises(UserRefused):
        world.people.add(name, "viewer", PHRASE)


def test_names_and_roles_are_checked(world: World) -> None:
    world.people.add("ana", "viewer", PHRASE)
    with pytest.raises(UserRefused, match="there is a user 'ana' already"):
        world.people.add("ana", "viewer", PHRASE)
    with pytest.raises(UserRefused, match="one of: viewer, operator, metrologist, approver, admin"):
        world.people.set_role("ana", "root")
    with pytest.raises(UserRefused, match="no user 'bob'"):
        world.people.set_password("bob", PHRASE)


def test_a_session_ends_by_idleness_age_password_role_and_disabling(world: World) -> None:
    people, clock = world.people, world.clock
    people.add("root", "admin", PHRASE)
    people.add("ana", "operator", PHRASE)

    def begin() -> str:
        return people.begin(people.get("ana"))

    secret = begin()
    for _ in range(12 * 6 - 1):  # used every ten minutes for just under twelve hours
        clock.later(minutes=10)
        assert people.by_session(secret).name == "user:ana"
    clock.later(minutes=11)
    assert people.by_session(secret) is ANONYMOUS
    idle = begin()
    clock.later(minutes=15, seconds=1)
    assert people.by_session(idle) is ANONYMOUS
    assert people.by_session(idle, to_stop=True).name == "user:ana"
    for change in (
        lambda: people.set_role("ana", "viewer"),
        lambda: people.set_password("ana", PHRASE + "!"),
        lambda: people.disable("ana"),
    ):
        secret = begin()
        assert people.by_session(secret) is not ANONYMOUS
        change()
        assert people.by_session(secret, to_stop=True) is ANONYMOUS
    people.disable("ana", enable=True)
    assert people.by_session(secret) is ANONYMOUS
    assert people.by_session("x" * 43) is ANONYMOUS


def test_a_login_gives_a_new_secret_and_ends_the_old_session(world: World) -> None:
    world.people.add("ana", "operator", PHRASE)
    ana = world.people.get("ana")
    first = world.people.begin(ana)
    second = world.people.begin(ana, first)
    assert first != second
    assert world.people.by_session(first) is ANONYMOUS
    assert world.people.by_session(second).role is Role.OPERATOR


def test_sessions_of_long_ago_are_cleared_away(world: World) -> None:
    world.people.add("ana", "operator", PHRASE)
    ana = world.people.get("ana")
    old = world.people.begin(ana)
    world.clock.later(days=31)
    new = world.people.begin(ana)
    assert world.store.people.session(digest_of(old)) is None
    assert world.store.people.session(digest_of(new)) is not None


def test_a_token_has_at_most_its_scopes_and_ends(world: World) -> None:
    people, clock = world.people, world.clock
    people.add("root", "admin", PHRASE)
    people.add("met", "metrologist", PHRASE)
    text = people.add_token("met", "ci", ["read", "measure"], 2)
    assert people.by_token(text).permissions == {Permission.READ, Permission.MEASURE, Permission.STOP}  # whoever starts may stop
    people.set_role("met", "viewer")  # the rights of today, not those of the day it was made
    assert people.by_token(text).permissions == {Permission.READ}
    people.disable("met")
    assert people.by_token(text) is ANONYMOUS
    people.disable("met", enable=True)
    assert people.by_token(text) is not ANONYMOUS
    flipped = text[:-1] + ("A" if text[-1] != "A" else "B")
    for wrong in (flipped, text + "A", "", "abbe__", text.replace("abbe_", "abbe-")):
        assert people.by_token(wrong) is ANONYMOUS
    clock.later(days=2)
    assert people.by_token(text) is ANONYMOUS
    again = people.add_token("met", "ci2", ["read"], 2)
    people.revoke_token("met", "ci2")
    assert people.by_token(again) is ANONYMOUS
    with pytest.raises(UserRefused, match="scopes of viewer: read"):
        people.add_token("met", "ci3", ["approve"], 2)


def test_somebody_always_manages_users(world: World) -> None:
    world.people.add("root", "admin", PHRASE)
    for change in (lambda: world.people.disable("root"), lambda: world.people.set_role("root", "viewer")):
        with pytest.raises(UserRefused, match="the only admin"):
            change()
    world.people.add("root2", "admin", PHRASE)
    world.people.disable("root")
    assert world.people.check("root", PHRASE) is None


def test_ten_wrong_pins_in_a_row_remove_the_pin_over_any_time_and_restart(world: World) -> None:
    world.people.add("olga", "operator", PHRASE)
    world.people.set_pin("olga", "582914")

    def tries(count: int) -> list[bool]:
        found = []
        for _ in range(count):
            people = UserAccounts(world.store, world.clock, world.people.passwords)  # as after a restart
            user, removed = people.check_pin("olga", "000000")
            assert user is None
            found.append(removed)
            world.clock.later(days=1)
        return found

    assert tries(9) == [False] * 9
    assert world.people.check_pin("olga", "582914")[0] is not None, "a right one ends the row"
    assert tries(10) == [False] * 9 + [True]
    assert world.people.with_pin() == []
    assert world.people.check_pin("olga", "582914") == (None, False)
    world.people.set_pin("olga", "582914")
    assert tries(1) == [False]


def test_a_right_pin_that_is_counted_after_the_tenth_wrong_one_is_refused(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """It has found the user while the PIN was still there."""
    world.people.add("olga", "operator", PHRASE)
    world.people.set_pin("olga", "582914")
    count = world.store.people.count_pin

    def late(user_id: int) -> int:
        monkeypatch.setattr(world.store.people, "count_pin", count)
        assert [world.people.check_pin("olga", "000000")[1] for _ in range(MOST_WRONG_PINS)][-1], "the PIN is removed meanwhile"
        return count(user_id)

    monkeypatch.setattr(world.store.people, "count_pin", late)
    assert world.people.check_pin("olga", "582914")[0] is None


def test_simultaneous_guesses_of_a_pin_get_ten_hashes_of_it(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    world.people.add("olga", "operator", PHRASE)
    world.people.set_pin("olga", "582914")
    barrier, count, checked, verify = threading.Barrier(16, timeout=10), world.store.people.count_pin, [], world.people.passwords.verify

    def met(user_id: int) -> int:
        barrier.wait()  # all have found the user with the PIN
        return count(user_id)

    def seen(kept: str | None, pin: str) -> bool:
        checked.append(kept)
        return verify(kept, pin)

    monkeypatch.setattr(world.store.people, "count_pin", met)
    monkeypatch.setattr(world.people.passwords, "verify", seen)
    with ThreadPoolExecutor(16) as pool:
        answers = list(pool.map(lambda n: world.people.check_pin("olga", f"{n:06}"), range(16)))
    assert [user for user, _ in answers] == [None] * 16
    assert len([kept for kept in checked if kept is not None]) == MOST_WRONG_PINS
    assert world.people.with_pin() == []


def test_wrong_pins_do_not_delay_the_password(world: World) -> None:
    lockout = Lockout(world.clock.monotonic_s)
    for _ in range(9):
        lockout.failed("olga", LoginOrigin("10.0.0.1", "panel", pin=True))
    assert lockout.wait_s("olga", LoginOrigin("10.0.0.1", "panel", pin=True)) > 0
    assert lockout.wait_s("olga", LoginOrigin("10.0.0.1", "panel")) == 0


def test_no_more_than_two_hashes_at_a_time() -> None:
    passwords = Passwords(memory_kib=1024, passes=1)
    kept = passwords.hash(PHRASE)
    start = threading.Barrier(8)

    def tries(_: int) -> list[bool]:
        start.wait()
        return [passwords.verify(kept if i % 2 else None, PHRASE) for i in range(6)]

    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(tries, range(8)))
    assert answers == [[False, True] * 3] * 8
    assert passwords.most_at_a_time == AT_A_TIME


def test_a_user_that_does_not_exist_takes_as_long(world: World) -> None:
    """Medians of interleaved tries at the real cost; the goal is less than 10 ms between them."""
    people = world.people
    people.passwords = Passwords()
    people.passwords.prepare()
    people.add("ana", "operator", PHRASE)
    took: dict[str, list[float]] = {"ana": [], "nobody": []}
    for _ in range(9):
        for name, times in took.items():
            begin = time.thread_time()  # of this thread: what else the computer does is not part of it
            assert people.check(name, "something else entirely") is None
            times.append(time.thread_time() - begin)
    assert abs(statistics.median(took["ana"]) - statistics.median(took["nobody"])) < 0.010


def test_a_thousand_tries_a_minute_are_at_most_ten_hashes(world: World) -> None:
    clock = world.clock
    lockout = Lockout(clock.monotonic_s)
    hashes = 0
    for _ in range(1000):
        if lockout.wait_s("ana", LoginOrigin("10.0.0.9")) == 0:
            hashes += 1
            lockout.failed("ana", LoginOrigin("10.0.0.9"))
        clock.later(seconds=0.06)
    assert 5 < hashes <= 10


def test_another_addresss_guesses_do_not_shut_out_who_has_been_here(world: World) -> None:
    clock = world.clock
    lockout = Lockout(clock.monotonic_s)
    lockout.succeeded("ana", LoginOrigin("10.0.0.1"))
    for _ in range(50):
        lockout.failed("ANA", LoginOrigin("10.0.0.9"))
    assert 0 < lockout.wait_s("ana", LoginOrigin("10.0.0.9")) <= 900
    assert lockout.wait_s("ana", LoginOrigin("10.0.0.8")) > 0
    assert lockout.wait_s("ana", LoginOrigin("10.0.0.1")) == 0
    clock.later(seconds=901)
    assert lockout.wait_s("ana", LoginOrigin("10.0.0.9")) == 0  # never for ever


def test_one_address_that_tries_many_names_has_to_wait(world: World) -> None:
    lockout = Lockout(world.clock.monotonic_s)
    tried = 0
    for number in range(100):
        if lockout.wait_s(f"user{number}", LoginOrigin("10.0.0.9")) == 0:
            tried += 1
            lockout.failed(f"user{number}", LoginOrigin("10.0.0.9"))
    assert tried == 20


def test_who_logs_in_is_no_guesser_however_many_share_his_address(world: World) -> None:
    """Each try is counted before the password is looked at: the count of those that were right is taken back."""
    lockout, shared = Lockout(world.clock.monotonic_s), LoginOrigin("10.0.0.9")
    for number in range(60):
        assert lockout.wait_s(f"user{number}", shared) == 0
        lockout.failed(f"user{number}", shared)
        lockout.succeeded(f"user{number}", shared)
    for number in range(19):  # one account of his own frees nobody from the count of his guesses
        lockout.failed(f"other{number}", shared)
        lockout.failed("user1", shared)
        lockout.succeeded("user1", shared)
    assert lockout.wait_s("other19", shared) == 0
    lockout.failed("other19", shared)
    lockout.succeeded("user1", shared)
    lockout.failed("other20", shared)
    assert lockout.wait_s("other21", shared) > 0


def test_what_is_counted_stays_small(world: World) -> None:
    lockout, buckets = Lockout(world.clock.monotonic_s), Buckets(1.0, 2.0, world.clock.monotonic_s)
    for number in range(MOST + 500):
        lockout.failed(f"u{number}", LoginOrigin(f"a{number}"))
        buckets.take(f"a{number}")
    assert len(lockout._counts) <= MOST
    assert len(buckets._left) <= MOST
    assert [buckets.take("x") for _ in range(3)] == [True, True, False]
    world.clock.later(seconds=1)
    assert buckets.take("x")
