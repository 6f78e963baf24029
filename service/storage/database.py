"""The open database: one writer thread, reader connections, and the bridge from asyncio."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import UTC, datetime
from typing import ParamSpec, Self, TypeVar

from sqlalchemy import Connection, Engine, text

from abbe.service.domain.utc import utc_text
from abbe.service.errors import StoreError
from abbe.service.secrets import mask_secrets
from abbe.service.storage.engine import DEFAULT_URL, READ_ONLY_OPTION, make_engine, translated
from abbe.service.storage.migrate import upgrade

P = ParamSpec("P")
T = TypeVar("T")


class Database:
    """Engine and writer thread. Any thread may call; in coroutines use ``await database.write(...)``.

    ``engine``: at the current schema. ``writer``: with exactly one thread: every write goes through it, so writes have one order and never
    wait for each other inside the database. ``utcnow``: the clock of the time columns.
    """

    def __init__(self, engine: Engine, writer: ThreadPoolExecutor, utcnow: Callable[[], datetime]) -> None:
        self.engine = engine
        self.utcnow = utcnow
        self._writer = writer
        self._writer_thread = writer.submit(threading.get_ident).result()
        self.in_memory = engine.dialect.name == "sqlite" and engine.url.database in {None, "", ":memory:"}
        self.url = mask_secrets(engine.url.render_as_string(hide_password=False))

    @classmethod
    def open(cls, url: str = DEFAULT_URL, *, utcnow: Callable[[], datetime] | None = None) -> Self:
        """Open a database, creating or upgrading its tables. Close it, or use it in a ``with`` statement.

        Parameters
        ----------
        url : str
            ``sqlite:///file``, ``sqlite://`` (memory) or ``postgresql://user@host/name``.
        utcnow : callable, optional
            Clock with time zone, for tests.

        Raises
        ------
        StoreError
            The file cannot be opened, is not a database, or belongs to a newer version.
        """
        engine = make_engine(url)
        writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="abbe-store")
        try:
            with translated(url):
                writer.submit(upgrade, engine).result()
            return cls(engine, writer, utcnow or (lambda: datetime.now(UTC)))
        except BaseException:
            writer.shutdown()
            engine.dispose()
            raise

    def close(self) -> None:
        """Finish pending writes and close every connection. May be called twice."""
        self._writer.shutdown(wait=True)
        self.engine.dispose()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_postgresql(self) -> bool:
        """Whether a PostgreSQL server stores the data; otherwise it is SQLite."""
        return self.engine.dialect.name == "postgresql"

    def now(self) -> str:
        """The present time as it is stored."""
        return utc_text(self.utcnow())

    async def write(self, fn: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run a method of a repository in the writer thread, without blocking the event loop.

        If the caller is cancelled while it waits, the write still happens: no sample is lost on the way.
        """
        return await asyncio.shield(asyncio.wrap_future(self._submit(fn, *args, **kwargs)))

    def _submit(self, fn: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        try:
            return self._writer.submit(fn, *args, **kwargs)
        except RuntimeError:
            raise StoreError(f"database {self.url} is closed", "open it again") from None

    def commit(self, work: Callable[[Connection], T]) -> T:
        """Do ``work`` in one transaction in the writer thread, and wait for it."""
        if threading.get_ident() == self._writer_thread:
            return self._transaction(work)
        return self._submit(self._transaction, work).result()

    def read(self, work: Callable[[Connection], T]) -> T:
        """Do ``work`` in one reading transaction, in the caller's thread."""
        if self.in_memory and threading.get_ident() != self._writer_thread:
            return self._submit(self._snapshot, work).result()  # a memory database has a single connection
        return self._snapshot(work)

    def _transaction(self, work: Callable[[Connection], T]) -> T:
        with translated(self.url), self.engine.begin() as connection:
            return work(connection)

    def _snapshot(self, work: Callable[[Connection], T]) -> T:
        with translated(self.url), self.engine.connect().execution_options(**{READ_ONLY_OPTION: True}) as connection:
            return work(connection)

    def check_writable(self) -> None:
        """Check that a write would succeed now; writes nothing.

        Raises
        ------
        StoreError
            The database is read-only, locked by another process, or gone.
        """
        # On SQLite BEGIN IMMEDIATE takes every lock that a write needs; a server states whether it takes writes.
        read_only = text("SELECT current_setting('transaction_read_only')")

        def work(connection: Connection) -> None:
            if self.is_postgresql and connection.execute(read_only).scalar_one() == "on":
                raise StoreError(f"database {self.url} takes no writes", "use the server that does")

        self.commit(work)
