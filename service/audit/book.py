"""The audit of a database with its two files beside it: the key of the seals (0600), and the heads, one line a record."""

from __future__ import annotations

import getpass
import os
import platform
import secrets
from pathlib import Path

from service.audit.chain import Anchor, Event, anchor_of, faults, follow
from service.errors import AuditBroken
from service.secrets import mask_secrets
from service.storage.engine import parse_url
from service.storage.store import Store
from service.storage.store_audit import AuditRecord

ENVIRONMENT = "ABBE_AUDIT_FOLDER"
KEY_BYTES = 32


class AuditBook:
    """Writes and proves the audit. Any thread may call.

    Parameters
    ----------
    store : Store
        The database.
    url : str
        Of it, with its path: the files lie beside a SQLite file. Of a server they lie in the folder that `ABBE_AUDIT_FOLDER` names, else
        in ``~/.local/state/abbe``, by the database's own name.
    """

    def __init__(self, store: Store, url: str) -> None:
        self._store = store
        self._key: bytes | None = None
        base = place(store, url)
        self._memory = base is None
        self.key_file = Path(f"{base}.audit-key")
        self.head_file = Path(f"{base}.audit-head")
        self._heads: list[Anchor] = []

    def write(self, event: Event) -> AuditRecord:
        """Append a record; on return it is on disk and its head is kept outside.

        Raises
        ------
        AuditBroken, StoreError
            It cannot be written.
        """
        key = self._key_of(make=True)
        event = Event(_short(event.who), _short(event.action), mask_secrets(event.target)[:2000], _short(event.outcome), _masked(event.doc))
        record = self._store.append_audit(lambda last, utc: follow(last, utc, event, key))
        self._keep(anchor_of(record, key))
        return record

    def verify(self) -> list[str]:
        """Everything that is wrong; an empty list: all is there and as written. An audit without a record has nothing wrong."""
        heads = self._heads if self._memory else self._read_heads()
        records = self._store.audit()
        if not records and not heads and not self.key_file.exists():
            return []
        try:
            key = self._key_of(make=False)
        except AuditBroken as error:
            return [error.detail]
        return faults(records, heads, key)

    def _key_of(self, *, make: bool) -> bytes:
        if self._key is None:
            self._key = secrets.token_bytes(KEY_BYTES) if self._memory else self._read_key(make=make)
        return self._key

    def _read_key(self, *, make: bool) -> bytes:
        try:
            if make and not self.key_file.exists():
                _new_key(self.key_file)
            key = self.key_file.read_bytes()
        except FileNotFoundError:
            raise AuditBroken(f"the key of the audit, {self.key_file}, is missing", "bring it back from the backup") from None
        except OSError as error:
            raise AuditBroken(
                f"{self.key_file}: {error.strerror}", "it has to belong to whoever runs the service, with rights 0600"
            ) from None
        if len(key) != KEY_BYTES:
            raise AuditBroken(f"{self.key_file} is no key of an audit", "bring it back from the backup")
        return key

    def _keep(self, anchor: Anchor) -> None:
        if self._memory:
            self._heads.append(anchor)
            return
        line = f"{anchor.id} {anchor.digest} {anchor.mac}\n".encode()
        try:
            # One short write at the end of the file: lines of two processes do not mix.
            file = os.open(self.head_file, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
            try:
                os.write(file, line)
                os.fsync(file)
            finally:
                os.close(file)
        except OSError as error:
            raise AuditBroken(f"{self.head_file}: {error.strerror}", "the record is in the database, its head is not kept") from None

    def _read_heads(self) -> list[Anchor]:
        try:
            lines = self.head_file.read_text(encoding="ascii", errors="replace").splitlines()
        except FileNotFoundError:
            return []
        except OSError as error:
            raise AuditBroken(f"{self.head_file}: {error.strerror}", "make it readable") from None
        return [anchor for anchor in map(_anchor, lines) if anchor is not None]


def place(store: Store, url: str) -> str | None:
    """Path of the audit's files without their ending; None for a database in memory."""
    parsed = parse_url(url)
    folder = os.environ.get(ENVIRONMENT)
    if parsed.drivername == "sqlite":
        if parsed.database in {None, "", ":memory:"}:
            return None
        path = Path(str(parsed.database)).resolve()
        return str(Path(folder) / path.name) if folder else str(path)
    home = Path(folder) if folder else Path.home() / ".local" / "state" / "abbe"
    try:
        home.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise AuditBroken(
            f"the folder of the audit's key, {home}, cannot be made: {error.strerror}", f"name another with {ENVIRONMENT}"
        ) from None
    return str(home / store.database_id())


def _new_key(path: Path) -> None:
    """Written aside and linked: whoever is second finds the first one's key, whole."""
    aside = Path(f"{path}.{secrets.token_hex(4)}")
    file = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        os.write(file, secrets.token_bytes(KEY_BYTES))
        os.fsync(file)
    finally:
        os.close(file)
    try:
        os.link(aside, path)
    except FileExistsError:
        pass
    finally:
        aside.unlink()


def _anchor(line: str) -> Anchor | None:
    """A kept head; None for a line that a power cut has torn. Whoever tears lines on purpose could as well remove them."""
    parts = line.split(" ")
    if len(parts) == 3 and parts[0].isdigit() and [len(part) for part in parts[1:]] == [64, 64] and len(parts[0]) < 18:
        return Anchor(int(parts[0]), parts[1], parts[2])
    return None


def this_account() -> str:
    """The account of the operating system that runs this process: ``os:NAME@HOST``."""
    try:
        name = getpass.getuser()
    except (KeyError, OSError):
        name = "?"
    return f"os:{name}@{platform.node()}"


def _short(text: str) -> str:
    return mask_secrets(text)[:200]


def _masked(doc: dict[str, object]) -> dict[str, object]:
    return {key: mask_secrets(value)[:2000] if isinstance(value, str) else value for key, value in doc.items()}
