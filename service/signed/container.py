"""FILE.sig: the claims about compensation files in canonical JSON, with an Ed25519 signature over exactly these bytes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from abbe.service.clock import utc_text
from abbe.service.domain.document import canonical
from abbe.service.errors import SignatureRefused
from abbe.service.signed.keys import public_of

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

FORM = "abbe-signed/1"
PURPOSE = b"abbe compensation files\x00"
"""Prefix of the signed bytes, so that a signature made for another purpose is invalid here."""
LARGEST = 1_000_000
NO_BASE = "none"
FILE_REMEDY = "get the files and their .sig again from the signer; nothing was imported"


@dataclass(frozen=True, slots=True)
class Claims:
    """The signed claims.

    ``form``: format or control of the files. ``files``: SHA-256 of each file's bytes, by name. ``base``: fingerprint of the table that was
    active while measuring, `NO_BASE` for none. ``limits``: SHA-256 of the machine's limits that the tables passed. ``expiry_utc``: end of
    the time in which the files may be imported.
    """

    machine: str
    form: str
    files: dict[str, str]
    base: str
    limits: str
    signed_utc: str
    expiry_utc: str


@dataclass(frozen=True, slots=True)
class ExpectedContent:
    """This machine's values, which the claims must match. ``base`` None: unknown here, so that the claimed base is not checked."""

    machine: str
    limits: str
    form: str
    trusted: Sequence[str]
    base: str | None = None


def claims_of(machine: str, form: str, files: Mapping[str, bytes], base: str, limits: str, span: tuple[datetime, datetime]) -> Claims:
    """The claims about files; ``span``: time of signing and of expiry."""
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    return Claims(machine, form, digests, base, limits, utc_text(span[0]), utc_text(span[1]))


def sign(claims: Claims, key: Ed25519PrivateKey) -> bytes:
    """Sign the claims; return the bytes of FILE.sig."""
    claimed = asdict(claims)
    return (
        canonical({"format": FORM, "key": public_of(key), "claims": claimed, "signature": key.sign(PURPOSE + canonical(claimed)).hex()})
        + b"\n"
    )


def check(sealed: bytes, files: Mapping[str, bytes], expected: ExpectedContent, now: datetime) -> Claims:
    """Return the claims of FILE.sig (``sealed``) if all of them hold for these files, this machine and ``now`` (with time zone).

    Raises
    ------
    SignatureRefused
        The files differ from the signed ones, the key is not trusted, the claims are for another machine, base, limits or format, or they
        have expired.
    """
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    key, claims, signature = _parts(sealed)
    if key not in expected.trusted:
        raise SignatureRefused(
            f"signed by {key[:16]}…, a key that is not trusted here",
            "put the public key under [signatures] trusted, or do not import the files",
        )
    try:
        Ed25519PublicKey.from_public_bytes(bytes.fromhex(key)).verify(signature, PURPOSE + canonical(asdict(claims)))
    except (InvalidSignature, ValueError):
        raise SignatureRefused("the signature does not match the claims", FILE_REMEDY) from None
    _check_files(claims, files)
    for what, claimed, here in (
        ("machine", claims.machine, expected.machine),
        ("format", claims.form, expected.form),
        ("limits", claims.limits, expected.limits),
        ("base", claims.base, claims.base if expected.base is None else expected.base),
    ):
        if claimed != here:
            raise SignatureRefused(
                f"signed for {what} {claimed[:64]!r}, but here it is {here[:64]!r}", "have the files signed for this machine as it is now"
            )
    if not _utc(claims.signed_utc) <= now < _utc(claims.expiry_utc):
        raise SignatureRefused(
            f"the signature is not valid now: signed {claims.signed_utc[:16]}, holds until {claims.expiry_utc[:16]} (UTC)",
            "have the files signed again, or set the clock of this computer",
        )
    return claims


def _check_files(claims: Claims, files: Mapping[str, bytes]) -> None:
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    if digests != claims.files:
        wrong = sorted(name for name in digests.keys() | claims.files.keys() if digests.get(name) != claims.files.get(name))
        raise SignatureRefused(f"{', '.join(wrong)}: differs from what was signed", FILE_REMEDY)


@dataclass(frozen=True, slots=True)
class _Sealed:
    """The keys of a .sig file: all of them are required, and no others are allowed."""

    format: str
    key: str
    claims: dict[str, Any]
    signature: str


def _parts(sealed: bytes) -> tuple[str, Claims, bytes]:
    """Key, claims and signature. Only the canonical encoding is accepted, so no two files carry the same claims."""
    try:
        if len(sealed) > LARGEST:
            raise ValueError
        doc: dict[str, Any] = json.loads(sealed.decode("utf-8"))
        found = _Sealed(**doc)
        claims, signature = Claims(**found.claims), bytes.fromhex(found.signature)
        if canonical(doc) + b"\n" != sealed or found.format != FORM:
            raise ValueError
        texts = [v for k, v in asdict(claims).items() if k != "files"] + [found.key, *claims.files.values()]
        if not all(isinstance(text, str) for text in texts) or signature.hex() != found.signature:
            raise ValueError
        _utc(claims.signed_utc), _utc(claims.expiry_utc)
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError):
        raise SignatureRefused(f"the .sig file is not of the form {FORM}, or was changed", FILE_REMEDY) from None
    return found.key, claims, signature


def _utc(text: str) -> datetime:
    found = datetime.fromisoformat(text)
    if found.tzinfo is None:
        raise ValueError
    return found.astimezone(UTC)
