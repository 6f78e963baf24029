"""Users: add, change, disable, log in and out, and find the owner of a secret.

Passwords: argon2id, two hashes at a time; an unknown user takes the same time as a known one.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from itertools import pairwise
from typing import TypeVar

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerifyMismatchError

from abbe.service.clock import Clock, utc_text
from abbe.service.domain.people import ALLOWED, Permission, Role, TokenRecord, UserRecord
from abbe.service.errors import PasswordRefused, UserRefused
from abbe.service.storage.store import Store

AT_A_TIME = 2
"""Concurrent hashes. Each takes 19 MiB and a processor for tens of milliseconds: many logins must not starve the capture."""
SHORTEST, LONGEST_PASSWORD = 12, 256
LEAST_DIFFERENT = 5
PIN, LEAST_DIFFERENT_DIGITS = re.compile(r"[0-9]{6,12}"), 3
PIN_ROLES = frozenset({Role.VIEWER, Role.OPERATOR})
"""Roles whose users may log in by PIN. A PIN is easier to guess than a password, so these roles may not propose, approve or manage."""
MOST_WRONG_PINS = 10
"""Wrong PINs in a row, at all browsers and over restarts, after which the PIN is removed."""
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
        """Whether a password matches a hash. Without a hash (unknown user) the check does the same work."""
        password = password[: LONGEST_PASSWORD + 1]  # longer ones never match; do not hash them in full

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
    if not SHORTEST <= len(password) <= LONGEST_PASSWORD:
        raise PasswordRefused(f"a password needs {SHORTEST} to {LONGEST_PASSWORD} characters", "use a sentence of a few words")
    if len(set(low)) < LEAST_DIFFERENT:
        raise PasswordRefused(f"the password has fewer than {LEAST_DIFFERENT} different characters", "use a sentence of a few words")
    if len(name) > 2 and name.lower() in low:
        raise PasswordRefused("the password contains the user name", "choose another")
    if any(word in low and len(low) - len(word) < 6 for word in COMMON):
        raise PasswordRefused("the password is one of the first that attackers try", "use a sentence of a few words")


def check_new_pin(pin: str) -> None:
    """Refuse a PIN that is easily guessed.

    Raises
    ------
    PasswordRefused
        The PIN has too few or too many digits, too few different ones, or counts up or down.
    """
    if not PIN.fullmatch(pin):
        raise PasswordRefused("a PIN needs 6 to 12 digits", "choose other digits")
    steps = {ord(b) - ord(a) for a, b in pairwise(pin)}
    if len(set(pin)) < LEAST_DIFFERENT_DIGITS or steps in ({1}, {-1}):
        raise PasswordRefused("the PIN is one of the first that people try", "choose other digits")


IDLE = timedelta(minutes=15)
LONGEST = timedelta(hours=12)
TOUCH = timedelta(seconds=30)
"""Shortest interval between stored uses of a session: a page that refreshes itself must not write each time."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")
DEVICE = re.compile(r"([0-9a-f]{32})\.([0-9]{1,11})\.([0-9a-f]{64})")
DEVICE_LIFE = timedelta(days=90)
"""How long a browser is recognized after a login by password."""
TOKEN = re.compile(r"abbe_([0-9a-f]{12})_([A-Za-z0-9_-]{43})")


@dataclass(frozen=True, slots=True)
class Principal:
    """The account behind a request, and its permissions.

    ``name``: ``user:NAME``, ``token:NAME/TOKEN`` or ``anonymous``, as in the audit. ``role``: None without an account. ``by``: what
    identified the account (``session`` or ``token``), or ``nobody``. ``digest``: SHA-256 of the session's secret.
    """

    name: str = "anonymous"
    role: Role | None = None
    permissions: frozenset[Permission] = frozenset()
    by: str = "nobody"
    digest: str = ""


ANONYMOUS = Principal()
LOCAL_VIEWER = Principal("anonymous", Role.VIEWER, ALLOWED[Role.VIEWER])
"""Any visitor of a service without users, which listens on this computer only and is read-only."""


class UserAccounts:
    """Users of one database."""

    def __init__(self, store: Store, clock: Clock, passwords: Passwords | None = None) -> None:
        self._store, self._clock = store, clock
        self.passwords = passwords or Passwords()

    def add(self, name: str, role: str, password: str) -> None:
        """Add a user.

        Raises
        ------
        UserRefused, PasswordRefused
            The name or role is invalid, the name is taken, or the password is weak.
        """
        if not NAME.fullmatch(name):
            raise UserRefused(f"{name!r} is not a valid user name", "use 1 to 64 letters, digits and . _ @ -; begin with a letter or digit")
        check_new(name, password)
        self._store.people.add(name, role_of(role), self.passwords.hash(password))

    def get(self, name: str) -> UserRecord:
        """A user by name. Raises UserRefused."""
        user = self._store.people.find(name)
        if user is None:
            raise UserRefused(f"there is no user {name!r}", "`abbe user list` lists them")
        return user

    def set_role(self, name: str, role: str) -> None:
        """Change a user's role; the user's sessions end, so that none keeps the old permissions."""
        user, new = self.get(name), role_of(role)
        self._store.people.change(user.id, keep_admin=new is not Role.ADMIN, role=new, pin=user.pin if new in PIN_ROLES else None)

    def set_password(self, name: str, password: str) -> None:
        """Change a user's password; the user's sessions end, and the PIN is removed."""
        user = self.get(name)
        check_new(name, password)
        self._store.people.change(user.id, password=self.passwords.hash(password), pin=None)

    def set_pin(self, name: str, pin: str) -> None:
        """Change a user's PIN; empty: remove it. Raises UserRefused for a role that needs a password, and PasswordRefused."""
        user = self.get(name)
        if pin and Role(user.role) not in PIN_ROLES:
            raise UserRefused(f"a user who is {user.role} logs in with a password only", "use the password")
        if pin:
            check_new_pin(pin)
        self._store.people.change(user.id, keep_session=True, pin=self.passwords.hash(pin) if pin else None, pin_failures=0)

    def disable(self, name: str, *, enable: bool = False) -> None:
        """Disable a user with all sessions and tokens, or enable it again. Users are never deleted: the audit names them."""
        user = self.get(name)
        self._store.people.change(user.id, keep_admin=not enable, disabled_utc=None if enable else utc_text(self._clock.utc()))

    def check(self, name: str, password: str) -> UserRecord | None:
        """The user, if the password matches and the user is enabled; else None. An unknown user takes the same time."""
        user = self._store.people.find(name) if NAME.fullmatch(name) else None
        right = self.passwords.verify(None if user is None else user.password, password)
        if not right or user is None or user.disabled_utc is not None:
            return None
        if self.passwords.outdated(user.password):
            self._store.people.change(user.id, keep_session=True, password=self.passwords.hash(password))
            return self._store.people.find(name)  # the cookie of the browser is sealed with the new hash
        return user

    def check_pin(self, name: str, pin: str) -> tuple[UserRecord | None, bool]:
        """The user, if the PIN matches, the role may use one and the user is enabled, else None; and whether this try removed the PIN.

        `MOST_WRONG_PINS` wrong tries in a row remove the PIN.
        """
        user = self._store.people.find(name) if NAME.fullmatch(name) else None
        if user is None or not _may_use_pin(user):
            self.passwords.verify(None, pin)
            return None, False
        # Counted before the check: simultaneous tries must not all find one left.
        tries = self._store.people.count_pin(user.id)
        if self.passwords.verify(user.pin if tries <= MOST_WRONG_PINS else None, pin):
            self._store.people.change(user.id, keep_session=True, pin_failures=0)
            return user, False
        if tries >= MOST_WRONG_PINS:
            # The count stays until there is a new PIN: a try that has found the old one must not count from zero.
            self._store.people.change(user.id, keep_session=True, pin=None)
        return None, tries >= MOST_WRONG_PINS

    def with_pin(self) -> list[UserRecord]:
        """Users who may log in by PIN."""
        return [user for user in self._store.people.all() if _may_use_pin(user)]

    def known(self, name: str) -> bool:
        """Whether there is such a user. Callers must not show or log an unknown name: it may be a mistyped password."""
        return bool(NAME.fullmatch(name)) and self._store.people.find(name) is not None

    def begin(self, user: UserRecord, instead_of: str = "") -> str:
        """Begin a session with a new secret and return it; the session with the secret ``instead_of`` ends."""
        secret = secrets.token_urlsafe(32)
        self._store.people.add_session(user.id, digest_of(secret), digest_of(instead_of) if instead_of else "")
        return secret

    def end(self, secret: str) -> None:
        """End a session."""
        self._store.people.end_session(digest_of(secret))

    def by_session(self, secret: str, *, in_use: bool = True, to_stop: bool = False) -> Principal:
        """Owner of a session's secret; `ANONYMOUS` if the session has ended, is idle or too old, or its user is disabled.

        ``in_use`` False: this request does not count as use of the session. ``to_stop``: the request stops the machine, which even an idle
        or too old session may do.
        """
        digest = digest_of(secret)
        found = self._store.people.session(digest)
        if found is None:
            return ANONYMOUS
        session, user = found
        now = self._clock.utc()
        last_used, begun = parse_utc(session.seen_utc), parse_utc(session.created_utc)
        over = now - last_used > IDLE or now - begun > LONGEST
        if session.ended_utc is not None or user.disabled_utc is not None or (over and not to_stop):
            return ANONYMOUS
        if in_use and not over and now - last_used > TOUCH:
            self._store.people.touch_session(session.id)
        role = Role(user.role)
        return Principal(f"user:{user.name}", role, ALLOWED[role], "session", digest)

    def device_of(self, name: str, cookie: str) -> str:
        """Id of a browser, if this user has logged in with it in the last `DEVICE_LIFE` and since the password was set; else empty.

        The cookie is not stored. The key of its seal is the hash of the user's password; this hash never leaves the database.
        """
        found = DEVICE.fullmatch(cookie) if NAME.fullmatch(name) else None
        user = self._store.people.find(name) if found else None
        if found is None or user is None:
            return ""
        label, end_s, seal = found.groups()
        right = hmac.compare_digest(seal, _device_seal(user, label, end_s))
        return label if right and self._clock.utc().timestamp() < int(end_s) else ""

    def new_device(self, user: UserRecord, label: str = "") -> str:
        """Make the cookie that identifies a browser at this user's next logins for `DEVICE_LIFE`; ``label``: id of a known browser."""
        label, end_s = label or secrets.token_hex(16), str(int((self._clock.utc() + DEVICE_LIFE).timestamp()))
        return f"{label}.{end_s}.{_device_seal(user, label, end_s)}"

    def add_token(self, name: str, title: str, scopes: list[str], days: float) -> str:
        """Make a token of a user; return its text, which is not stored.

        Raises
        ------
        UserRefused, StoreError
            The user or a scope does not exist, a scope exceeds the user's role, the life time is invalid, or the title is taken.
        """
        user = self.get(name)
        if not NAME.fullmatch(title):
            raise UserRefused(f"{title!r} is not a valid name of a token", "use 1 to 64 letters, digits and . _ @ -")
        if not 0 < days <= 3660:
            raise UserRefused(f"a token cannot be valid for {days:g} days", "give more than 0 and at most 3660")
        beyond = [s for s in scopes if s not in ALLOWED[Role(user.role)]]
        if beyond or not scopes:
            known = ", ".join(sorted(ALLOWED[Role(user.role)]))
            what = f"cannot have the scope {', '.join(beyond)}" if beyond else "needs a scope"
            raise UserRefused(f"a token of {name!r} {what}", f"scopes of {user.role}: {known}")
        prefix, secret = secrets.token_hex(6), secrets.token_urlsafe(32)
        text = f"abbe_{prefix}_{secret}"
        expires = utc_text(self._clock.utc() + timedelta(days=days))
        self._store.people.add_token(
            TokenRecord(user_id=user.id, name=title, prefix=prefix, digest=digest_of(text), scopes=sorted(set(scopes)), expires_utc=expires)
        )
        return text

    def revoke_token(self, name: str, title: str) -> None:
        """Revoke a token. Raises UserRefused if there is none of this name."""
        found = [token for token, owner in self._store.people.tokens() if (owner.name, token.name) == (name, title)]
        if not found:
            raise UserRefused(f"{name!r} has no token {title!r}", "`abbe user token list` lists them")
        self._store.people.revoke_token(found[0].id)

    def by_token(self, text: str) -> Principal:
        """Owner of a token, with the present permissions of its user within the token's scopes; `ANONYMOUS` if it is not valid."""
        match = TOKEN.fullmatch(text)
        found = self._store.people.token(match[1]) if match else None
        if found is None:
            return ANONYMOUS
        token, user = found
        right = hmac.compare_digest(token.digest, digest_of(text))
        over = parse_utc(token.expires_utc) <= self._clock.utc()
        if not right or over or token.revoked_utc is not None or user.disabled_utc is not None:
            return ANONYMOUS
        role = Role(user.role)
        scopes = frozenset(Permission(s) for s in token.scopes)
        if Permission.MEASURE in scopes:  # whoever may start may stop
            scopes |= {Permission.STOP}
        return Principal(f"token:{user.name}/{token.name}", role, ALLOWED[role] & scopes, "token")

    def has_users(self) -> bool:
        """Whether there is any user, even a disabled one; if so, reading needs a login."""
        return bool(self._store.people.all())


def role_of(text: str) -> Role:
    """A role by name. Raises UserRefused."""
    try:
        return Role(text)
    except ValueError:
        raise UserRefused(f"there is no role {text!r}", f"one of: {', '.join(Role)}") from None


def _may_use_pin(user: UserRecord) -> bool:
    return user.pin is not None and user.disabled_utc is None and Role(user.role) in PIN_ROLES


def _device_seal(user: UserRecord, label: str, end_s: str) -> str:
    key = hashlib.sha256(b"abbe device " + user.password.encode()).digest()
    return hmac.new(key, f"{user.name} {label} {end_s}".encode(), hashlib.sha256).hexdigest()


def digest_of(secret: str) -> str:
    """Return the SHA-256 of a secret. A secret has 256 random bits, so it needs no slow hash."""
    return hashlib.sha256(secret.encode()).hexdigest()


def parse_utc(text: str) -> datetime:
    """Parse a stored time into UTC."""
    return datetime.fromisoformat(text).astimezone(UTC)
