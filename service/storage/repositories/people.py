"""Store methods for users, sessions and tokens. Secrets come in as digests or hashes only; `abbe.service.users` decides what they mean."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

from sqlalchemy import Connection, delete, func, insert, select, update

from abbe.service.domain.people import SessionRecord, TokenRecord, UserRecord
from abbe.service.errors import StoreError
from abbe.service.storage.base import StoreBase, utc_text
from abbe.service.storage.mapping import RecordMapping
from abbe.service.storage.repositories.campaigns import new_id
from abbe.service.storage.tables_people import api_tokens, sessions, users

USER, SESSION, TOKEN = RecordMapping(UserRecord, users), RecordMapping(SessionRecord, sessions), RecordMapping(TokenRecord, api_tokens)


class PeopleStore(StoreBase):
    """Users, their sessions and their tokens."""

    def add_user(self, name: str, role: str, password: str) -> int:
        """Add a user; ``password`` is an argon2id hash.

        Raises
        ------
        StoreError
            There is one of this name.
        """

        def work(connection: Connection) -> int:
            if connection.execute(select(users.c.id).where(users.c.name == name)).first() is not None:
                raise StoreError(f"there is a user {name!r} already", "give another name")
            return new_id(connection, insert(users).values(name=name, role=role, password=password, created_utc=self._now()))

        return self._write(work)

    def users(self) -> list[UserRecord]:
        """List all users, disabled ones too."""
        return [USER.read(row) for row in self._read(lambda connection: connection.execute(USER.select().order_by(users.c.id)).all())]

    def user(self, name: str) -> UserRecord | None:
        """Find a user by name."""
        row = self._read(lambda connection: connection.execute(USER.select().where(users.c.name == name)).first())
        return None if row is None else USER.read(row)

    def active_admins(self) -> int:
        """Count the admins who may log in: not disabled, and with the hash of a password."""
        query = select(func.count()).select_from(users)
        query = query.where(users.c.disabled_utc.is_(None), users.c.role == "admin", users.c.password.like("$argon2%"))
        return int(self._read(lambda connection: connection.execute(query).scalar_one()))

    def change_user(self, user_id: int, keep_session: bool = False, **values: Any) -> None:
        """Change role, password or ``disabled_utc`` of a user, and end his sessions in the same transaction."""

        def work(connection: Connection) -> None:
            connection.execute(update(users).where(users.c.id == user_id).values(**values))
            if not keep_session:
                connection.execute(_ended(self._now()).where(sessions.c.user_id == user_id))

        self._write(work)

    def add_session(self, user_id: int, digest: str, instead_of: str = "") -> int:
        """Begin a session; the one of digest ``instead_of`` ends with it. What began a month ago is long over, and is cleared away."""

        def work(connection: Connection) -> int:
            now = self._now()
            connection.execute(delete(sessions).where(sessions.c.created_utc < utc_text(self._utcnow() - timedelta(days=30))))
            if instead_of:
                connection.execute(_ended(now).where(sessions.c.digest == instead_of))
            return new_id(connection, insert(sessions).values(user_id=user_id, digest=digest, created_utc=now, seen_utc=now))

        return self._write(work)

    def session(self, digest: str) -> tuple[SessionRecord, UserRecord] | None:
        """Find a session, ended ones too, and whose it is."""
        query = select(*SESSION.columns, *USER.columns).join(users, users.c.id == sessions.c.user_id).where(sessions.c.digest == digest)
        row = self._read(lambda connection: connection.execute(query).first())
        return None if row is None else (SESSION.read(row), USER.read(row))

    def touch_session(self, session_id: int) -> None:
        """Note that a session was used just now."""
        self._write(lambda connection: connection.execute(update(sessions).where(sessions.c.id == session_id).values(seen_utc=self._now())))

    def end_session(self, digest: str) -> None:
        """End a session; nothing happens if there is none."""
        self._write(lambda connection: connection.execute(_ended(self._now()).where(sessions.c.digest == digest)))

    def add_token(self, token: TokenRecord) -> int:
        """Add a token; its ``id`` and ``created_utc`` are given here.

        Raises
        ------
        StoreError
            The user has one of this name.
        """

        def work(connection: Connection) -> int:
            same = (api_tokens.c.user_id == token.user_id) & (api_tokens.c.name == token.name)
            if connection.execute(select(api_tokens.c.id).where(same)).first() is not None:
                raise StoreError(f"this user has a token {token.name!r} already", "give another name; a revoked token keeps its own")
            values = TOKEN.values(token, "id", "revoked_utc") | {"created_utc": self._now()}
            return new_id(connection, insert(api_tokens).values(values))

        return self._write(work)

    def token(self, prefix: str) -> tuple[TokenRecord, UserRecord] | None:
        """Find a token by its prefix, revoked ones too, and whose it is."""
        query = select(*TOKEN.columns, *USER.columns).join(users, users.c.id == api_tokens.c.user_id).where(api_tokens.c.prefix == prefix)
        row = self._read(lambda connection: connection.execute(query).first())
        return None if row is None else (TOKEN.read(row), USER.read(row))

    def tokens(self) -> list[tuple[TokenRecord, str]]:
        """List all tokens with the names of their users."""
        query = select(*TOKEN.columns, users.c.name).join(users, users.c.id == api_tokens.c.user_id).order_by(api_tokens.c.id)
        return [(TOKEN.read(row), row.name) for row in self._read(lambda connection: connection.execute(query).all())]

    def revoke_token(self, token_id: int) -> None:
        """Revoke a token, for ever."""
        unused = api_tokens.c.revoked_utc.is_(None)
        statement = update(api_tokens).where((api_tokens.c.id == token_id) & unused)
        self._write(lambda connection: connection.execute(statement.values(revoked_utc=self._now())))


def _ended(now: str) -> Any:
    return update(sessions).where(sessions.c.ended_utc.is_(None)).values(ended_utc=now)
