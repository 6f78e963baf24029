"""The audit of a database, and its two files outside the database: the key and the heads.

Each record holds the digest of the record before it, and a seal: the HMAC of its own digest with the key. A head is the id, digest and seal
of a record. The file of heads has one line per record, so that removed records are noticed.

`login` names the account of a command in records and journals.
"""

from __future__ import annotations

import errno
import getpass
import hashlib
import hmac
import os
import platform
import secrets
import stat
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from abbe.service.domain.document import GENESIS, canonical
from abbe.service.domain.service_records import AuditEvent
from abbe.service.errors import AuditBroken
from abbe.service.secrets import mask_secrets, visible
from abbe.service.storage.engine import parse_url, private_file
from abbe.service.storage.store import Store


@dataclass(frozen=True, slots=True)
class Anchor:
    """A head, kept outside the database: id, digest and seal of a record."""

    id: int
    digest: str
    mac: str


def key_name(key: bytes) -> str:
    """Return the name by which records refer to a key; it reveals nothing about the key."""
    return hashlib.sha256(b"abbe audit key " + key).hexdigest()[:16]


def mac_of(key: bytes, digest: str) -> str:
    """Return the seal of a digest. It cannot be forged without the key."""
    return hmac.new(key, digest.encode(), hashlib.sha256).hexdigest()


def digest_of(event: AuditEvent) -> str:
    """Return the SHA-256 of a record's content, which includes the digest of the record before it."""
    content = [event.id, event.utc, event.who, event.action, event.target, event.outcome, event.doc, event.prev, event.key]
    return hashlib.sha256(canonical(content)).hexdigest()


def follow(last: AuditEvent | None, utc: str, event: AuditEvent, key: bytes) -> AuditEvent:
    """Turn an event into the record that follows ``last``."""
    number, prev = (1, GENESIS) if last is None else (last.id + 1, last.digest)
    placed = replace(event, id=number, utc=utc, prev=prev, key=key_name(key))
    digest = digest_of(placed)
    return replace(placed, digest=digest, mac=mac_of(key, digest))


def faults(records: Sequence[AuditEvent], anchors: Sequence[Anchor], key: bytes) -> list[str]:
    """Return all faults of an audit; none if it is complete and unchanged.

    ``records``: all records, in the order of their ids; ``anchors``: the heads kept outside the database; ``key``: key of the seals.
    """
    found, head, own_key = [], GENESIS, key_name(key)
    for number, record in enumerate(records, 1):
        if record.id != number:
            found.append(f"record {number} is missing")
            break
        if record.prev != head:
            found.append(f"record {number} does not follow the one before it")
        if record.digest != _digest_or_none(record):
            found.append(f"record {number} was changed after it was written")
        if record.key != own_key:
            found.append(f"record {number} is sealed with another key ({record.key})")
        elif not hmac.compare_digest(record.mac, mac_of(key, record.digest)):
            found.append(f"record {number} was not sealed by this service")
        head = record.digest
    return found + _anchor_faults(records, anchors, key)


def _digest_or_none(record: AuditEvent) -> str | None:
    try:
        return digest_of(record)
    except (TypeError, ValueError):  # no longer JSON
        return None


def _anchor_faults(records: Sequence[AuditEvent], anchors: Sequence[Anchor], key: bytes) -> list[str]:
    """Compare the records with the heads kept outside the database; return the faults."""
    found, stored = [], {record.id: record.digest for record in records}
    for anchor in anchors:
        if not hmac.compare_digest(anchor.mac, mac_of(key, f"{anchor.id} {anchor.digest}")):
            found.append(f"the checksum kept outside the database for record {anchor.id} was not sealed by this service")
        elif anchor.id not in stored:
            found.append(f"record {anchor.id} was written and is missing: the audit holds {len(records)} records")
        elif stored[anchor.id] != anchor.digest:
            found.append(f"record {anchor.id} differs from its checksum kept outside the database")
    if records and not anchors:
        found.append("no checksums are kept outside the database: nobody would notice removed records")
    return found


def anchor_of(record: AuditEvent, key: bytes) -> Anchor:
    """Return the head of a record."""
    return Anchor(record.id, record.digest, mac_of(key, f"{record.id} {record.digest}"))


# The two files of the audit: only their owner may read them; errors name the owner.


def create(path: Path, content: bytes) -> None:
    """Create a file with all its content at once; keep the existing file if another process was faster."""
    aside = Path(f"{path}.{secrets.token_hex(4)}")
    file = private_file(aside)
    try:
        os.write(file, content)
        os.fsync(file)
    finally:
        os.close(file)
    try:
        os.link(aside, path)
    except FileExistsError:
        pass
    finally:
        aside.unlink()


def can_create(path: Path) -> None:
    """Raise the OSError that creating this file would raise; leave nothing behind."""
    aside = Path(f"{path}.{secrets.token_hex(4)}")
    os.close(private_file(aside))
    aside.unlink()


def can_append(path: Path) -> None:
    """Raise the OSError that appending to this file, or creating it, would raise; leave nothing behind."""
    try:
        os.close(os.open(path, os.O_WRONLY | os.O_APPEND))
    except FileNotFoundError:
        can_create(path)


def append_line(path: Path, text: str) -> None:
    """Append a line durably. A line before it that a power cut left incomplete stays a line of its own."""
    with suppress(FileExistsError):
        os.close(private_file(path))
    file = os.open(path, os.O_RDWR | os.O_APPEND)
    try:
        size = os.fstat(file).st_size
        torn = size > 0 and os.lseek(file, -1, os.SEEK_END) >= 0 and os.read(file, 1) != b"\n"
        line = (b"\n" if torn else b"") + f"{text}\n".encode()
        # One short write with O_APPEND: lines of two processes do not mix.
        if os.write(file, line) != len(line):
            raise OSError(errno.ENOSPC, "only a part of the line could be written")
        os.fsync(file)
    finally:
        os.close(file)


def refusal(path: Path, error: OSError) -> AuditBroken:
    """Return the error for an unusable file of the audit: system message, owner of the file, account of this process, remedy."""
    owner, details = "", ""
    with suppress(OSError, KeyError, NotImplementedError):
        there = path if path.exists() else path.parent
        owner = there.owner()
        details = (
            f" ({'it' if there == path else there} belongs to {owner}, rights {stat.S_IMODE(there.stat().st_mode):04o}{_own_account()})"
        )
    who = f"run this as {owner}, or give the file" if owner not in {"", "root"} else "give the file"
    return AuditBroken(
        f"the audit cannot be used: {path}: {error.strerror or error}{details}",
        f"{who} to the account of the service (chown) with rights 0600; see docs/how-to/users.md",
    )


def _own_account() -> str:
    if not hasattr(os, "geteuid"):
        return ""
    import pwd

    number = os.geteuid()
    try:
        return f"; this is {pwd.getpwuid(number).pw_name}"
    except KeyError:
        return f"; this is account {number}"


ENVIRONMENT = "ABBE_AUDIT_FOLDER"
KEY_BYTES = 32
KEY, HEADS = ".audit-key", ".audit-head"


class AuditBook:
    """Writes and verifies the audit of the database ``url``. Any thread may call.

    The files lie in the folder that `ABBE_AUDIT_FOLDER` names. Without it they lie beside a SQLite file; for a database server in
    ``~/.local/state/abbe``, named after the id of the database.
    """

    def __init__(self, store: Store, url: str) -> None:
        self._store = store
        self._key: bytes | None = None
        base = files_base(store, url)
        self._memory = base is None
        self.key_file, self.head_file = files_of(str(base))
        self._heads: list[Anchor] = []

    def ready(self) -> None:
        """Check that a record can be written, before an action that needs one. Leaves nothing behind.

        Raises
        ------
        AuditBroken, StoreError
            Names the unusable file or database, its owner and the remedy.
        """
        if not self._memory:
            files_ready(self.key_file, self.head_file)
        self._store.check_writable()

    def write(self, event: AuditEvent) -> AuditEvent:
        """Append a record; on return the record and its head are on disk.

        Raises
        ------
        AuditBroken, StoreError
            The record cannot be written.
        """
        key = self._key_of(make=True)
        cleaned = AuditEvent(
            who=_clean(event.who)[:200],
            action=_clean(event.action)[:200],
            target=_clean(event.target)[:2000],
            outcome=_clean(event.outcome)[:200],
            doc=_clean_document(event.doc),
        )
        record = self._store.audit.append(lambda last, utc: follow(last, utc, cleaned, key))
        self._keep(anchor_of(record, key))
        return record

    def verify(self) -> list[str]:
        """Return all faults; none if the audit is complete and unchanged, or was never begun."""
        heads = self._heads if self._memory else heads_in(self.head_file)
        records = self._store.audit.events()
        try:
            if not records and not heads and not self._has_key():
                return []
            key = self._key_of(make=False)
        except AuditBroken as error:
            return [error.detail]
        found = faults(records, heads, key)
        if not records and not heads and not self._memory:
            found.append(f"the audit is empty, but its key is here ({self.key_file}): somebody removed all its records and checksums")
        return found

    def _has_key(self) -> bool:
        try:
            return self._key is not None or (not self._memory and self.key_file.exists())
        except OSError as error:
            raise refusal(self.key_file, error) from None

    def _key_of(self, *, make: bool) -> bytes:
        if self._key is None:
            self._key = secrets.token_bytes(KEY_BYTES) if self._memory else read_key(self.key_file, make=make)
        return self._key

    def _keep(self, anchor: Anchor) -> None:
        if self._memory:
            self._heads.append(anchor)
            return
        try:
            append_line(self.head_file, f"{anchor.id} {anchor.digest} {anchor.mac}")
        except OSError as error:
            raise AuditBroken(
                refusal(self.head_file, error).detail,
                "the record is in the database, but this file lacks its checksum; make the file writable",
            ) from None


def heads_in(file: Path) -> list[Anchor]:
    """Return the heads in a file, in their order; an empty list if there is no file.

    Raises
    ------
    AuditBroken
        The file cannot be read.
    """
    try:
        lines = file.read_text(encoding="ascii", errors="replace").splitlines()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise refusal(file, error) from None
    return [anchor for anchor in map(_anchor, lines) if anchor is not None]


def files_of(base: str) -> tuple[Path, Path]:
    """Paths of the key and the heads of an audit."""
    return Path(f"{base}.audit-key"), Path(f"{base}.audit-head")


def sqlite_base(database: Path) -> str:
    """Return the path of a SQLite file's audit files, without suffix; in a shared folder a hash separates databases of the same name."""
    folder, path = os.environ.get(ENVIRONMENT), database.resolve()
    if not folder:
        return str(path)
    return str(Path(folder) / f"{path.name}-{hashlib.sha256(str(path).encode()).hexdigest()[:8]}")


def _sqlite_files_base(store: Store | None, database: Path) -> str:
    """Return the path of `sqlite_base`, or that of earlier versions of Abbe, if the key there sealed the last record."""
    base, folder = sqlite_base(database), os.environ.get(ENVIRONMENT)
    if store is None or not folder or files_of(base)[0].exists():
        return base
    before = str(Path(folder) / database.name)
    last = store.audit.events(1)
    with suppress(OSError):
        if last and last[0].key == key_name(files_of(before)[0].read_bytes()):
            return before
    return base


def read_key(file: Path, *, make: bool) -> bytes:
    """Read the key of the seals; with ``make`` create a missing one.

    Raises
    ------
    AuditBroken
        The key is missing, invalid, or cannot be read or created.
    """
    try:
        if make and not file.exists():
            create(file, secrets.token_bytes(KEY_BYTES))
        key = file.read_bytes()
    except FileNotFoundError:
        raise AuditBroken(f"the key of the audit, {file}, is missing", "restore it from the backup") from None
    except OSError as error:
        raise refusal(file, error) from None
    if len(key) != KEY_BYTES:
        raise AuditBroken(f"{file} is not a key of an audit", "restore it from the backup")
    return key


def files_ready(key_file: Path, head_file: Path) -> None:
    """Check that key and heads can be used or created; leave nothing behind.

    Raises
    ------
    AuditBroken
        Names the unusable file.
    """
    file = key_file
    try:
        if key_file.exists():
            read_key(key_file, make=False)
        else:
            can_create(key_file)
        file = head_file
        can_append(head_file)
    except OSError as error:
        raise refusal(file, error) from None


def files_base(store: Store | None, url: str) -> str | None:
    """Return the path of the audit's files, without suffix; None for a database in memory.

    Without a ``store``, ``url`` names a SQLite file.
    """
    parsed = parse_url(url)
    folder = os.environ.get(ENVIRONMENT)
    if parsed.drivername == "sqlite" or store is None:
        if parsed.database in {None, "", ":memory:"}:
            return None
        return _sqlite_files_base(store, Path(str(parsed.database)))
    home = Path(folder) if folder else Path.home() / ".local" / "state" / "abbe"
    try:
        home.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise AuditBroken(
            f"the folder of the audit's key, {home}, cannot be created: {error.strerror}", f"name another folder in {ENVIRONMENT}"
        ) from None
    return str(home / store.database_id())


def _anchor(line: str) -> Anchor | None:
    """Parse a line of the heads file; None for a line cut short by a power cut.

    Such a line helps no attacker: to cut a line short does no more than to remove it.
    """
    parts = line.split(" ")
    if len(parts) == 3 and parts[0].isdigit() and [len(part) for part in parts[1:]] == [64, 64] and len(parts[0]) < 18:
        return Anchor(int(parts[0]), parts[1], parts[2])
    return None


def login() -> str:
    """The account that runs this command line."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a service account without a name
        return f"user {os.getuid()}"


def by_whom() -> str:
    """How the journal of pushes names the account of this command line."""
    return f"{login()}, by the command line"


def this_account() -> str:
    """The operating system account of this process: ``os:NAME@HOST``."""
    return f"os:{login()}@{platform.node()}"


def _clean(text: str) -> str:
    """Mask passwords and make every character safe for terminals, files and databases."""
    return visible(mask_secrets(text))


def _clean_document(value: Any) -> Any:
    """`_clean` for all texts of a document, cut to 2000 characters."""
    if isinstance(value, dict):
        return {_clean(str(key)): _clean_document(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_clean_document(inner) for inner in value]
    return _clean(value)[:2000] if isinstance(value, str) else value
