"""Users, sessions and tokens. Secrets arrive as digests or hashes only; `abbe.service.users` interprets them."""

from __future__ import annotations

from datetime import timedelta

from sqlalchemy import ColumnElement, Connection, Update, delete, func, select, update

from abbe.service.clock import utc_text
from abbe.service.domain.people import SessionRecord, TokenRecord, UserRecord
from abbe.service.errors import StoreError, UserRefused
from abbe.service.storage.database import SESSION, TOKEN, USER, Repository, dialect_insert, insert_row
from abbe.service.storage.tables import api_tokens, sessions, users

_ACTIVE_ADMIN = (users.c.disabled_utc.is_(None), users.c.role == "admin", users.c.password.like("$argon2%"))
FORGOTTEN = timedelta(days=30)
"""Age at which the row of a session is deleted; the session itself has ended long before."""


class People(Repository):
    """Users, their sessions and their tokens."""

    def add(self, name: str, role: str, password: str) -> int:
        """Add a user; ``password`` is an argon2id hash.

        Raises
        ------
        UserRefused
            The name is taken.
        """

        def work(connection: Connection) -> int:
            fresh = dialect_insert(connection, users).values(name=name, role=role, password=password, created_utc=self._db.now())
            once = fresh.on_conflict_do_nothing().returning(users.c.id)  # two may add one name at the same time
            taken = connection.execute(select(users.c.id).where(users.c.name == name)).first() is not None
            number = None if taken else connection.execute(once).scalar()
            if number is None:
                raise UserRefused(f"there is a user {name!r} already", "give another name")
            return int(number)

        return self._db.commit(work)

    def all(self) -> list[UserRecord]:
        """List all users, disabled ones too."""
        return self._all(USER)

    def find(self, name: str) -> UserRecord | None:
        """Find a user by name."""
        return self._first(USER, users.c.name == name)

    def active_admins(self) -> int:
        """Count the admins who can log in: those not disabled who have a password."""
        query = select(func.count()).select_from(users).where(*_ACTIVE_ADMIN)
        return int(self._db.read(lambda connection: connection.execute(query).scalar_one()))

    def change(self, user_id: int, *, keep_session: bool = False, keep_admin: bool = False, **values: str | int | None) -> None:
        """Change role, password, PIN or ``disabled_utc`` of a user, and end the user's sessions in the same transaction.

        Raises
        ------
        UserRefused
            With ``keep_admin``: the user is the only active admin.
        """

        def work(connection: Connection) -> None:
            if keep_admin:
                # PostgreSQL lets others write at the same time: the locks make them wait, and then see this change.
                admins = connection.execute(select(users.c.id, users.c.name).where(*_ACTIVE_ADMIN).order_by(users.c.id).with_for_update())
                found = admins.all()
                if [admin.id for admin in found] == [user_id]:
                    raise UserRefused(f"{found[0].name!r} is the only admin", "make another user admin first: abbe user role")
            connection.execute(update(users).where(users.c.id == user_id).values(**values))
            if not keep_session:
                connection.execute(_ended(self._db.now()).where(sessions.c.user_id == user_id))

        self._db.commit(work)

    def count_pin(self, user_id: int) -> int:
        """Count a try of a user's PIN as wrong; return the number of wrong ones in a row."""
        statement = update(users).where(users.c.id == user_id).values(pin_failures=users.c.pin_failures + 1).returning(users.c.pin_failures)
        return int(self._db.commit(lambda connection: connection.execute(statement).scalar_one()))

    def add_session(self, user_id: int, digest: str, instead_of: str = "") -> int:
        """Begin a session and end the one of digest ``instead_of`` (empty: none); delete rows older than a month."""

        def work(connection: Connection) -> int:
            now = self._db.now()
            connection.execute(delete(sessions).where(sessions.c.created_utc < utc_text(self._db.utcnow() - FORGOTTEN)))
            if instead_of:
                connection.execute(_ended(now).where(sessions.c.digest == instead_of))
            return insert_row(connection, sessions, user_id=user_id, digest=digest, created_utc=now, seen_utc=now)

        return self._db.commit(work)

    def session(self, digest: str) -> tuple[SessionRecord, UserRecord] | None:
        """Find a session, even an ended one, and its user."""
        query = SESSION.select().add_columns(*USER.columns).join(users, users.c.id == sessions.c.user_id)
        row = self._db.read(lambda connection: connection.execute(query.where(sessions.c.digest == digest)).first())
        return None if row is None else (SESSION.read(row), USER.read(row))

    def touch_session(self, session_id: int) -> None:
        """Store that a session was used now."""
        statement = update(sessions).where(sessions.c.id == session_id).values(seen_utc=self._db.now())
        self._db.commit(lambda connection: connection.execute(statement))

    def end_session(self, digest: str) -> None:
        """End a session; does nothing if there is none."""
        self._db.commit(lambda connection: connection.execute(_ended(self._db.now()).where(sessions.c.digest == digest)))

    def add_token(self, token: TokenRecord) -> int:
        """Add a token; return its id.

        Raises
        ------
        StoreError
            The user has a token of this name.
        """

        def work(connection: Connection) -> int:
            same = (api_tokens.c.user_id == token.user_id) & (api_tokens.c.name == token.name)
            if connection.execute(select(api_tokens.c.id).where(same)).first() is not None:
                raise StoreError(f"this user has a token {token.name!r} already", "give another name; a revoked token keeps its name")
            return insert_row(connection, api_tokens, **TOKEN.values(token, "id", "created_utc"), created_utc=self._db.now())

        return self._db.commit(work)

    def token(self, prefix: str) -> tuple[TokenRecord, UserRecord] | None:
        """Find a token by its prefix, even a revoked one, and its user."""
        found = self._tokens(api_tokens.c.prefix == prefix)
        return found[0] if found else None

    def tokens(self) -> list[tuple[TokenRecord, UserRecord]]:
        """List all tokens with their users."""
        return self._tokens()

    def _tokens(self, *conditions: ColumnElement[bool]) -> list[tuple[TokenRecord, UserRecord]]:
        query = TOKEN.select().add_columns(*USER.columns).join(users, users.c.id == api_tokens.c.user_id)
        rows = self._db.read(lambda connection: connection.execute(query.where(*conditions).order_by(api_tokens.c.id)).all())
        return [(TOKEN.read(row), USER.read(row)) for row in rows]

    def revoke_token(self, token_id: int) -> None:
        """Revoke a token for good."""
        statement = update(api_tokens).where(api_tokens.c.id == token_id, api_tokens.c.revoked_utc.is_(None))
        self._db.commit(lambda connection: connection.execute(statement.values(revoked_utc=self._db.now())))


def _ended(now: str) -> Update:
    """Return the statement that ends open sessions; the caller adds the condition."""
    return update(sessions).where(sessions.c.ended_utc.is_(None)).values(ended_utc=now)
