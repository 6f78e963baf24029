"""The store's engine room: one writer thread, reader connections, and the bridge from asyncio."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import UTC, datetime
from typing import ParamSpec, Self, TypeVar

from sqlalchemy import Connection, Engine

from abbe.service.errors import StoreError
from abbe.service.secrets import mask_secrets
from abbe.service.storage.engine import DEFAULT_URL, READ_ONLY_OPTION, make_engine, translated
from abbe.service.storage.migrate import upgrade

P = ParamSpec("P")
T = TypeVar("T")


def utc_text(moment: datetime) -> str:
    """Write a moment so that text order is time order.

    Parameters
    ----------
    moment : datetime
        With time zone.

    Returns
    -------
    str
        ISO 8601 in UTC with microseconds, e.g. ``2026-11-21T03:34:03.000000Z``.

    Raises
    ------
    StoreError
        If the moment has no time zone: nobody knows when it was.
    """
    if moment.tzinfo is None:
        raise StoreError(f"time {moment.isoformat()} has no time zone", "give one")
    return moment.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")


class StoreBase:
    """Owns engine and writer thread. Use ``Store.open``.

    Parameters
    ----------
    engine : Engine
        The database, at the current schema.
    writer : ThreadPoolExecutor
        With exactly one thread: every write goes through it, so writes have one order and never wait for each other inside the database.
    utcnow : callable
        The clock of the time columns.
    """

    def __init__(self, engine: Engine, writer: ThreadPoolExecutor, utcnow: Callable[[], datetime]) -> None:
        self._engine = engine
        self._writer = writer
        self._utcnow = utcnow
        self._writer_thread = writer.submit(threading.get_ident).result()
        self._in_memory = engine.dialect.name == "sqlite" and engine.url.database in {None, "", ":memory:"}
        self.url = mask_secrets(engine.url.render_as_string(hide_password=False))

    @classmethod
    def open(cls, url: str = DEFAULT_URL, *, utcnow: Callable[[], datetime] | None = None) -> Self:
        """Open a database, creating or upgrading its tables.

        Parameters
        ----------
        url : str
            ``sqlite:///file``, ``sqlite://`` (memory) or ``postgresql://user@host/name``.
        utcnow : callable, optional
            Clock with time zone, for tests.

        Returns
        -------
        Store
            Close it, or use it in a ``with`` statement.

        Raises
        ------
        StoreError
            If it cannot be opened, is no database, or belongs to a newer version.
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
        """Finish the writes under way and close every connection. May be called twice."""
        self._writer.shutdown(wait=True)
        self._engine.dispose()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    async def write(self, fn: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run one of this store's methods in the writer thread, without blocking the event loop.

        Parameters
        ----------
        fn : callable
            E.g. ``store.append_chunk``.
        *args, **kwargs
            Its arguments.

        Returns
        -------
        T
            What ``fn`` returned. If the caller is cancelled while waiting, the write still happens: samples are never dropped on the way.
        """
        return await asyncio.shield(asyncio.wrap_future(self._submit(fn, *args, **kwargs)))

    def _submit(self, fn: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        try:
            return self._writer.submit(fn, *args, **kwargs)
        except RuntimeError:
            raise StoreError(f"database {self.url} is closed", "open it again") from None

    def _write(self, work: Callable[[Connection], T]) -> T:
        """Do ``work`` in one transaction in the writer thread, and wait for it."""
        if threading.get_ident() == self._writer_thread:
            return self._transaction(work)
        return self._submit(self._transaction, work).result()

    def _read(self, work: Callable[[Connection], T]) -> T:
        """Do ``work`` in one reading transaction, in the caller's thread."""
        if self._in_memory and threading.get_ident() != self._writer_thread:
            return self._submit(self._snapshot, work).result()  # a memory database has a single connection
        return self._snapshot(work)

    def _transaction(self, work: Callable[[Connection], T]) -> T:
        with translated(self.url), self._engine.begin() as connection:
            return work(connection)

    def _snapshot(self, work: Callable[[Connection], T]) -> T:
        with translated(self.url), self._engine.connect().execution_options(**{READ_ONLY_OPTION: True}) as connection:
            return work(connection)

    def _now(self) -> str:
        return utc_text(self._utcnow())
