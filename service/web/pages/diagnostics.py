"""Diagnostics for an admin: versions, database, outbox; and the support bundle, which contains no secrets."""

from __future__ import annotations

import io
import json
import platform
import re
import shutil
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from abbe.service.campaign_data.provenance import versions
from abbe.service.domain.service_records import StoreHealth
from abbe.service.queries.reader import json_value
from abbe.service.queries.status import Status
from abbe.service.secrets import mask_secrets
from abbe.service.web.api.sources import Sources

# Possible secrets are removed from texts and documents before these leave the plant. When in doubt, text is removed.

HIDDEN = "***"
_NAMED = r"(?:pass(?:word|phrase|wd|code)|pwd|secret|token|api[_-]?key|private[_-]?key|credential|cookie|authori[sz]ation|csrf)"
_KEY = re.compile(rf"(?i){_NAMED}|^pass$|^abbe[_-]")
_PEM = re.compile(r"-----BEGIN [^-]*PRIVATE KEY-----.*?(?:-----END [^-]*PRIVATE KEY-----|\Z)", re.DOTALL)
_URL = re.compile(r"""(?<=://)([^:/@\s]*):[^\s"']+(?=@)""")
_HEADER = re.compile(r"""(?i)((?:cookie|authori[sz]ation)(?:\\*["']?\s*[:=]|\\*["']\s*,)\s*)[^\r\n]+""")
"""The value of a header may contain blanks, as in `Basic dXNlcjpwYXNz` and `one=1; two=2`: it ends at the end of the line."""
_SCHEME = re.compile(r"((?i:\bbearer)\s+|\bBasic\s+(?=[A-Za-z0-9+/_-]{8}))[^\s\"']+")
_BEFORE = rf"""(?:{_NAMED}|\bpass)[\w-]*(?:\\*["']?\s*[:=]|\\*["']\s*,)\s*|\babbe[_-][\w.-]*="""
_QUOTED = re.compile(rf"""(?i)({_BEFORE})[bru]{{0,2}}(\\*)(["']).*?(?:(?<!\\)\2\3|(?=[\r\n])|\Z)""")
"""A quoted value ends at its closing quotes, escaped like the opening ones, or at the end of its line."""
_BARE = re.compile(rf"""(?i)({_BEFORE})(?!\*\*\*)\S+""")


def blanked(text: str) -> str:
    """A text with possible secrets hidden: passwords in URLs, values after names of secrets, login headers, private keys."""
    text = _URL.sub(rf"\1:{HIDDEN}", mask_secrets(_PEM.sub(HIDDEN, text)))
    text = _SCHEME.sub(rf"\g<1>{HIDDEN}", _HEADER.sub(rf"\g<1>{HIDDEN}", text))
    return _BARE.sub(rf"\g<1>{HIDDEN}", _QUOTED.sub(rf"\g<1>{HIDDEN}", text))


def blanked_doc(value: Any) -> Any:
    """A document with possible secrets hidden: in every text (before JSON escapes it), and everything under the name of a secret."""
    if isinstance(value, Mapping):
        return {blanked(str(key)): HIDDEN if _is_secret(str(key), one) else blanked_doc(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        if len(value) == 2 and isinstance(value[0], str) and _is_secret(value[0], value[1]):  # a header as a pair
            return [value[0], HIDDEN]
        return [blanked_doc(one) for one in value]
    return value if value is None or isinstance(value, bool | int | float) else blanked(str(value))


def blanked_line(line: str) -> str:
    """A log line with possible secrets hidden: in its parts if it is JSON, else in the whole text."""
    try:
        parsed = json.loads(line)
    except ValueError:
        return blanked(line)
    return json.dumps(blanked_doc(parsed), ensure_ascii=False) if isinstance(parsed, dict | list) else blanked(line)


def _is_secret(key: str, value: object) -> bool:
    return _KEY.search(key) is not None and value is not None and not isinstance(value, bool) and value != ""


DAY_S = 86_400.0
MEGA = 1e6
FIXED = (2026, 1, 1, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """State of the installation; sizes in bytes.

    ``growth_b``: average per day, None on the first day; ``free_b``: None if the database is on another computer.
    """

    version: str
    python: str
    system: str
    database: str
    health: StoreHealth
    growth_b: float | None
    free_b: int | None
    outbox_oldest_s: float | None

    @property
    def program(self) -> str:
        """Versions of Abbe, Python and the operating system."""
        return f"Abbe {self.version}, Python {self.python}, {self.system}"

    @property
    def current(self) -> bool:
        """Whether the database has this program's schema."""
        return self.health.revision == self.health.wanted_revision


def diagnosis(sources: Sources, version: str) -> Diagnosis:
    """The current state of the installation."""
    store, now = sources.reader.store, sources.reader.clock.utc()
    found: StoreHealth = store.health()
    since = None if found.since_utc is None else datetime.fromisoformat(found.since_utc)
    days = 0.0 if since is None else (now - since).total_seconds() / DAY_S
    oldest = None if found.outbox_oldest_utc is None else (now - datetime.fromisoformat(found.outbox_oldest_utc)).total_seconds()
    free = shutil.disk_usage(Path(found.file).parent).free if found.file else None
    growth_b = found.size_b / days if days >= 1.0 else None
    return Diagnosis(version, platform.python_version(), platform.platform(), store.url, found, growth_b, free, oldest)


def megabytes(size_b: float) -> str:
    """A size in MB as text."""
    return f"{size_b / MEGA:.1f} MB"


def config_of(sources: Sources, status: Status, broker: str) -> dict[str, Any]:
    """The parts of the machine file that this process knows; they contain no keys or passwords, except in URLs."""
    return {
        "machine": sources.reader.machine,
        "database": sources.reader.store.url,
        "broker": broker,
        "devices": {device.role: device.url for device in status.devices},
        "schedules": [asdict(one) for one in sources.schedules],
        "limits_um": dict(sources.rules.limits_um),
        "calibrated_until": {k: v.isoformat() for k, v in (sources.rules.calibrated_until or {}).items()},
        "temperature_c": sources.rules.temperature_c,
    }


def bundle(diagnosis: Diagnosis, config: Mapping[str, Any], status: Status, log: Sequence[str]) -> bytes:
    """The support bundle as a zip file. Secrets in its files are blanked."""
    members = {
        "config.json": _json(config),
        "diagnosis.json": _json(asdict(diagnosis)),
        "log.txt": "\n".join(blanked_line(line) for line in log) + "\n",
        "status.json": _json(json_value(status)),
        "versions.json": _json(versions()),
    }
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in members.items():
            archive.writestr(zipfile.ZipInfo(name, FIXED), text, zipfile.ZIP_DEFLATED)
    return out.getvalue()


def _json(value: object) -> str:
    return json.dumps(blanked_doc(value), indent=2, ensure_ascii=False) + "\n"
