"""Ed25519 keys in files, readable by their owner only (0600)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from abbe.service.errors import KeyRefused

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey


def new_key(path: Path) -> str:
    """Write a new private key; return its public key, 64 hex digits.

    Raises
    ------
    KeyRefused
        The file exists or cannot be written.
    """
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    key = Ed25519PrivateKey.generate()
    text = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    try:
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            os.write(file, text)
            os.fsync(file)
        finally:
            os.close(file)
    except FileExistsError:
        raise KeyRefused(f"{path} exists already, and a key is never overwritten", "give another name") from None
    except OSError as error:
        raise KeyRefused(f"{path}: cannot be written: {error.strerror}", "give a writable folder") from None
    return public_of(key)


def read_key(path: Path) -> Ed25519PrivateKey:
    """Read a private key.

    Raises
    ------
    KeyRefused
        The file cannot be read, is not an Ed25519 key, or is readable by others.
    """
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        if os.name == "posix" and path.stat().st_mode & 0o077:
            raise KeyRefused(f"{path}: others may read this key", f"chmod 600 {path}, or make a new key if others may have read it")
        found = load_pem_private_key(path.read_bytes(), None)
    except OSError as error:
        raise KeyRefused(f"{path}: cannot be read: {error.strerror}", "make a key: abbe key new FILE") from None
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise KeyRefused(f"{path} holds no private key, or one with a password", "make a key: abbe key new FILE") from None
    if not isinstance(found, Ed25519PrivateKey):
        raise KeyRefused(f"{path} holds no Ed25519 key", "make a key: abbe key new FILE")
    return found


def public_of(key: Ed25519PrivateKey) -> str:
    """The public key, 64 hex digits."""
    return key.public_key().public_bytes_raw().hex()
