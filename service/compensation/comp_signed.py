"""Sign the files of an export, and judge imported files: signed for this machine, or a candidate only."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from abbe.service.compensation.comp_export import LARGEST_FILE
from abbe.service.config_schema import MachineFile
from abbe.service.errors import FileFormatError, SignatureRefused
from abbe.service.files import NotPlainError, read_plain
from abbe.service.formats.text import TextFile
from abbe.service.rendering.page_file import write_page
from abbe.service.signed.container import LARGEST, NO_BASE, Claims, ExpectedContent, check, claims_of, sign
from abbe.service.signed.keys import read_key
from abbe.service.site import site_of

LONGEST_DAYS = 366.0


@dataclass(frozen=True, slots=True)
class SealStatus:
    """The verdict on a signature. ``claims`` None: the files are a candidate, to be compared but never pushed as they are."""

    claims: Claims | None
    why: str

    @property
    def signed(self) -> bool:
        """Whether a trusted person signed everything for this machine and the signature still holds."""
        return self.claims is not None


@dataclass(frozen=True, slots=True)
class SigningRequest:
    """What an import states: the format, trusted keys besides the machine file's, the base in force."""

    form: str
    trusted: tuple[str, ...] = ()
    base: str | None = None


def signature_file(path: Path) -> Path:
    """Path of the signature, beside its file or folder."""
    return path.with_name(path.name + ".sig")


@dataclass(frozen=True, slots=True)
class TableSeal:
    """How a person signs: key, days of validity from now, base."""

    key: Path
    days: float
    base: str = NO_BASE


def check_signing(doc: dict[str, Any], config: MachineFile | None, seal: TableSeal) -> MachineFile:
    """Check everything that can prevent signing before any file is written.

    Raises
    ------
    KeyRefused, SignatureRefused
        There is no key, no valid span, no machine file, or the solution belongs to another machine.
    """
    read_key(seal.key)
    if config is None:
        raise SignatureRefused("a signature needs a machine, and none is given", "give --machine FILE; nothing was written")
    if not 0 < seal.days <= LONGEST_DAYS:
        raise SignatureRefused(f"a signature cannot hold for {seal.days:g} days", f"more than 0, at most {LONGEST_DAYS:g}")
    name = doc["machine"].get("name")
    if name != config.name:
        raise SignatureRefused(
            f"the solution is of machine {name!r}, the machine file of {config.name!r}", "give the solution's machine file"
        )
    return config


def sign_files(out: Path, form: str, config: MachineFile, seal: TableSeal, now: datetime) -> Path:
    """Sign the files at ``out``; return the path of the signature.

    Raises
    ------
    KeyRefused, SignatureRefused, FileFormatError
        There is no key, or a file cannot be read or written.
    """
    span = (now, now + timedelta(days=seal.days))
    claims = claims_of(config.name, form, contents(out), seal.base, site_of(config).limits.digest(), span)
    target = signature_file(out)
    write_page(sign(claims, read_key(seal.key)).decode(), target)
    return target


def seal_status(path: Path, read: Sequence[TextFile], config: MachineFile | None, ask: SigningRequest, now: datetime) -> SealStatus:
    """Judge the signature of the files at ``path``, whose text is ``read``.

    Raises
    ------
    SignatureRefused
        There is a signature and it does not hold: that is worse than none.
    """
    seal = signature_file(path)
    if not seal.exists():
        return SealStatus(None, "not signed")
    if config is None:
        return SealStatus(None, "signed, but the machine is unknown: give --machine")
    try:
        sealed = read_plain(seal, LARGEST)
    except NotPlainError as error:
        raise SignatureRefused(f"{seal}: {error.strerror}", "remove it: then the files are a candidate") from None
    except OSError as error:
        raise FileFormatError(
            f"{seal}: cannot be read: {error.strerror}", "make it readable, or remove it: then it is a candidate"
        ) from None
    expected = ExpectedContent(config.name, site_of(config).limits.digest(), ask.form, [*ask.trusted, *config.signatures.trusted], ask.base)
    found = contents(path)
    claims = check(sealed, found, expected, now)
    if {f.name: f.text for f in read} != {name: io.StringIO(held.decode("utf-8"), None).read() for name, held in found.items()}:
        raise SignatureRefused(f"{path} was changed while it was read", "try again; nothing was taken in")
    return SealStatus(claims, f"signed {claims.signed_utc[:16]}, holds until {claims.expiry_utc[:16]} (UTC)")


def contents(path: Path) -> dict[str, bytes]:
    """Names and bytes of a file, or of all files of a folder.

    Raises
    ------
    FileFormatError
        A file cannot be read.
    """
    try:
        paths = sorted(p for p in path.iterdir() if p.is_file() and not p.name.startswith(".")) if path.is_dir() else [path]
        return {p.name: read_plain(p, LARGEST_FILE) for p in paths}
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read: {error.strerror}", "give a file or a folder") from None
