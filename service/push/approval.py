"""What a person agrees to: exactly this table, on exactly this base, for this machine, under these limits, until then."""

from __future__ import annotations

import hashlib

from abbe.service.push.entries import Doc, canonical


def approval_digest(known: Doc, expiry: str) -> str:
    """SHA-256 that an approval binds.

    Parameters
    ----------
    known : dict
        Facts of the push's SNAPSHOT: image, base_image (hex), machine, limits.
    expiry : str
        When the approval ends.
    """
    return hashlib.sha256(canonical([known["image"], known["base_image"], known["machine"], known["limits"], expiry])).hexdigest()
