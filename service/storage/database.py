"""The open database (one writer thread, reader connections, the bridge from asyncio), the mapping of its rows to records, and the base of
the repositories.

A field of a record is the column of the same name, unless its mapping names another column or a nested record. A field of a text enum is
read as its member.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from enum import StrEnum
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, Self, TypeVar, get_type_hints

from sqlalchemy import Column, ColumnElement, Connection, Engine, FromClause, Row, Select, Table, func, insert, null, select, text
from sqlalchemy.dialects.sqlite import Insert as SqliteInsert
from sqlalchemy.dialects.sqlite import insert as sqlite_insert

from abbe.service.clock import utc_text
from abbe.service.domain import measured, people, push_entry, results, service_records
from abbe.service.domain.document import document
from abbe.service.domain.document import record as parse_record
from abbe.service.domain.measured import Owner
from abbe.service.errors import NotStored, StoreError
from abbe.service.secrets import mask_secrets
from abbe.service.storage import tables as t
from abbe.service.storage.engine import DEFAULT_URL, READ_ONLY_OPTION, make_engine, translated, upgrade

if TYPE_CHECKING:
    from sqlalchemy.dialects.postgresql import Insert as PostgresInsert

P = ParamSpec("P")
T = TypeVar("T")


class Database:
    """Engine and writer thread. Any thread may call; in coroutines use ``await database.write(...)``.

    ``engine``: its database has the current schema. ``writer``: has exactly one thread, which does every write, so that writes have one
    order and never wait for each other inside the database. ``utcnow``: the clock of the time columns.
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
            Returns the present time with time zone; for tests.

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
        """Whether a PostgreSQL server stores the data; False: SQLite does."""
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
            raise StoreError(f"database {self.url} is closed", "open the database again") from None

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
                raise StoreError(f"database {self.url} is read-only", "use the primary server, which takes writes")

        self.commit(work)


R = TypeVar("R")


class RecordMapping(Generic[R]):
    """A frozen record class, and the columns that its records are read from and written to.

    SQLAlchemy's own mapper writes its state into the object and refuses frozen ones (decision 0037).

    ``source``: the FROM clause to read, if it is more than the table. ``**other``: expression or nested mapping of each field that is not
    the column of the same name. A JSON column whose field is a dataclass is parsed into it, and written without its defaults.
    """

    def __init__(
        self, record: type[R], table: Table, source: FromClause | None = None, **other: ColumnElement[Any] | RecordMapping[Any]
    ) -> None:
        assert is_dataclass(record)
        self.table, self._source = table, table if source is None else source
        self._make: type[R] = record
        self._prefix = f"{table.name}_{record.__name__}_"
        names, self._by_name = [one.name for one in fields(record)], any(one.kw_only for one in fields(record))
        if missing := [name for name in names if name not in other and name not in table.c]:
            raise TypeError(f"{record.__name__}: table {table.name} has no column {', '.join(missing)}")
        self._fields = {name: other[name] if name in other else table.c[name] for name in names}
        self._nested = {name: column for name, column in self._fields.items() if isinstance(column, RecordMapping)}
        self._labels = {name: self._prefix + name for name in names if name not in self._nested}

    @cached_property
    def _kinds(self) -> dict[str, type]:
        """Fields whose type is a class; found at the first use, since a command reads few of the tables."""
        return {name: kind for name, kind in get_type_hints(self._make).items() if isinstance(kind, type)}

    @cached_property
    def _enums(self) -> dict[str, type[StrEnum]]:
        return {name: kind for name, kind in self._kinds.items() if issubclass(kind, StrEnum)}

    @cached_property
    def _documents(self) -> dict[str, type]:
        return {name: kind for name, kind in self._kinds.items() if is_dataclass(kind) and name not in self._nested}

    @cached_property
    def _plain(self) -> bool:
        return not (self._nested or self._enums or self._documents or self._by_name)

    @property
    def columns(self) -> list[ColumnElement[Any]]:
        """The columns to select for `read`."""
        found: list[ColumnElement[Any]] = []
        for name, column in self._fields.items():
            found += column.columns if isinstance(column, RecordMapping) else [column.label(self._prefix + name)]
        return found

    def select(self) -> Select[Any]:
        """All rows, in no order."""
        return select(*self.columns).select_from(self._source)

    def read(self, row: Row[*tuple[Any, ...]]) -> R:
        """The record of a row that holds `columns` and possibly others."""
        if self._plain and len(row) == len(self._labels):
            return self._make(*row)  # in the order of the fields; a long run has a hundred thousand chunks
        return self.from_values(row._mapping)  # noqa: SLF001 - SQLAlchemy's public name

    def from_values(self, values: Mapping[Any, Any]) -> R:
        """The record made from values, given by the labels of `columns`."""
        found = {name: values[label] for name, label in self._labels.items()}
        for name, mapping in self._nested.items():
            found[name] = mapping.from_values(values)
        for name, kind in self._enums.items():
            found[name] = kind(found[name])
        for name, document_kind in self._documents.items():
            found[name] = parse_record(document_kind, found[name], f"a row of {self.table.name}")
        return self._make(**found)

    def values(self, record: R, *without: str) -> dict[str, Any]:
        """Values of a record by column of its table, except the fields ``without``."""
        found: dict[str, Any] = {}
        for name, column in self._fields.items():
            if isinstance(column, RecordMapping):
                found |= column.values(getattr(record, name))
            elif isinstance(column, Column) and column.table is self.table and name not in without:
                value = getattr(record, name)
                if name in self._documents:
                    value = document(value, stated_only=True)
                found[column.name] = value.value if name in self._enums else value
        return found


def owner_of(table: Table) -> RecordMapping[Owner]:
    """Mapping of the process that owns a row."""
    return RecordMapping(Owner, table, host=table.c.owner_host, pid=table.c.owner_pid, start=table.c.owner_start)


MACHINE = RecordMapping(measured.MachineRecord, t.machines)
CAMPAIGN = RecordMapping(measured.CampaignRecord, t.campaigns)
RUN = RecordMapping(
    measured.RunRecord,
    t.runs,
    t.runs.join(t.campaigns, t.campaigns.c.id == t.runs.c.campaign_id),
    campaign=t.campaigns.c.name,
    owner=owner_of(t.runs),
)
CHUNK = RecordMapping(measured.ChunkRecord, t.chunks)
CHECKPOINT = RecordMapping(measured.CheckpointRecord, t.checkpoints)

SOLUTION = RecordMapping(results.SolutionRecord, t.solutions)
TABLE = RecordMapping(results.TableRecord, t.comp_tables)
VERIFICATION = RecordMapping(results.VerificationRecord, t.verifications)
DISCOVERY = RecordMapping(results.DiscoveryRecord, t.discoveries)
STEP = RecordMapping(results.StepRecord, t.discovery_steps)
MODEL = RecordMapping(results.ModelRecord, t.machine_models)

PROPOSAL = RecordMapping(results.ProposalRecord, t.proposals)
APPROVAL = RecordMapping(results.ProposalApproval, t.approvals)
REJECTION = RecordMapping(results.ProposalRejection, t.rejections)
PUSH_ENTRY = RecordMapping(push_entry.PushEntry, t.push_entries, number=t.push_entries.c.id)
PUSH_MARK = RecordMapping(push_entry.PushEntry, t.push_entries, number=t.push_entries.c.id, doc=null())
"""A push entry without its document, which holds the images of tables."""

ALARM_ENTRY = RecordMapping(service_records.AlarmEntryRecord, t.alarm_entries, facts=t.alarm_entries.c.doc)
SLOT = RecordMapping(service_records.SlotRecord, t.slots, reason=func.coalesce(t.slots.c.reason, ""))
HEARTBEAT = RecordMapping(service_records.HeartbeatRecord, t.heartbeats, owner=owner_of(t.heartbeats))
OUTBOX = RecordMapping(service_records.OutboxRecord, t.outbox)
REPLY = RecordMapping(service_records.ReplyRecord, t.replies)

USER = RecordMapping(people.UserRecord, t.users)
SESSION = RecordMapping(people.SessionRecord, t.sessions)
TOKEN = RecordMapping(people.TokenRecord, t.api_tokens)
AUDIT = RecordMapping(service_records.AuditEvent, t.audit)

Order = ColumnElement[Any]


class Repository:
    """Base of the repositories."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def _all(
        self,
        of: RecordMapping[R],
        *conditions: ColumnElement[bool],
        order: Order | None = None,
        newest: bool = False,
        limit: int | None = None,
    ) -> list[R]:
        """All records that match, sorted by ``order`` (default: id), descending if ``newest``."""
        by = of.table.c.id if order is None else order
        query = of.select().where(*conditions).order_by(by.desc() if newest else by).limit(limit)
        return [of.read(row) for row in self._db.read(lambda connection: connection.execute(query).all())]

    def _first(self, of: RecordMapping[R], *conditions: ColumnElement[bool]) -> R | None:
        """The first record that matches, None if there is none."""
        return next(iter(self._all(of, *conditions, limit=1)), None)

    def _get(self, of: RecordMapping[R], number: int, what: str, remedy: str = "") -> R:
        """The record of an id. Raises NotStored."""
        found = self._first(of, of.table.c.id == number)
        if found is None:
            raise NotStored(f"no {what} {number} in {self._db.url}", remedy)
        return found

    def _add(self, table: Table, **values: object) -> int:
        """Insert one row in a transaction of its own; return its id."""
        return self._db.commit(lambda connection: insert_row(connection, table, **values))


def insert_row(connection: Connection, table: Table, **values: object) -> int:
    """Insert one row; return its id."""
    key = connection.execute(insert(table).values(**values)).inserted_primary_key
    assert key is not None
    return int(key[0])


def if_given(column: Column[Any], value: object) -> list[ColumnElement[bool]]:
    """The condition that a column equals a value; no condition for None."""
    return [] if value is None else [column == value]


def dialect_insert(connection: Connection, table: Table) -> PostgresInsert | SqliteInsert:
    """An insert with ON CONFLICT clauses, whose syntax differs between databases."""
    if connection.dialect.name != "postgresql":
        return sqlite_insert(table)
    from sqlalchemy.dialects.postgresql import insert as postgres_insert  # a tenth of a second for every command

    return postgres_insert(table)
