"""What could be a secret, taken out of texts and documents before they leave the house. Rather too much is blanked than too little."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from abbe.service.secrets import mask_secrets

HIDDEN = "***"
_NAMED = r"(?:pass(?:word|phrase|wd|code)|pwd|secret|token|api[_-]?key|private[_-]?key|credential|cookie|authori[sz]ation|csrf)"
_KEY = re.compile(rf"(?i){_NAMED}|^pass$|^abbe[_-]")
_PEM = re.compile(r"-----BEGIN [^-]*PRIVATE KEY-----.*?(?:-----END [^-]*PRIVATE KEY-----|\Z)", re.DOTALL)
_URL = re.compile(r"""(?<=://)([^:/@\s]*):[^\s"']+(?=@)""")
_HEADER = re.compile(r"""(?i)((?:cookie|authori[sz]ation)(?:\\*["']?\s*[:=]|\\*["']\s*,)\s*)[^\r\n]+""")
"""A header's value has no end but the line's: `Basic dXNlcjpwYXNz`, `one=1; two=2`."""
_SCHEME = re.compile(r"((?i:\bbearer)\s+|\bBasic\s+(?=[A-Za-z0-9+/_-]{8}))[^\s\"']+")
_BEFORE = rf"""(?:{_NAMED}|\bpass)[\w-]*(?:\\*["']?\s*[:=]|\\*["']\s*,)\s*|\babbe[_-][\w.-]*="""
_QUOTED = re.compile(rf"""(?i)({_BEFORE})[bru]{{0,2}}(\\*)(["']).*?(?:(?<!\\)\2\3|(?=[\r\n])|\Z)""")
"""A value in quotes ends with the quotes that it began with, however often they are escaped, or with the line where that was cut."""
_BARE = re.compile(rf"""(?i)({_BEFORE})(?!\*\*\*)\S+""")


def blanked(text: str) -> str:
    """A text without what could be a secret: passwords of URLs, what follows a word for one, headers of logins, private keys."""
    text = _URL.sub(rf"\1:{HIDDEN}", mask_secrets(_PEM.sub(HIDDEN, text)))
    text = _SCHEME.sub(rf"\g<1>{HIDDEN}", _HEADER.sub(rf"\g<1>{HIDDEN}", text))
    return _BARE.sub(rf"\g<1>{HIDDEN}", _QUOTED.sub(rf"\g<1>{HIDDEN}", text))


def blanked_doc(value: Any) -> Any:
    """A document without them: every text of its own, before any of them is escaped, and whole what stands under a word for a secret."""
    if isinstance(value, Mapping):
        return {blanked(str(key)): HIDDEN if _holds(str(key), one) else blanked_doc(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        if len(value) == 2 and isinstance(value[0], str) and _holds(value[0], value[1]):  # a header as a pair
            return [value[0], HIDDEN]
        return [blanked_doc(one) for one in value]
    return value if value is None or isinstance(value, bool | int | float) else blanked(str(value))


def blanked_line(line: str) -> str:
    """A line of a log: by its parts if it is JSON, else as text."""
    try:
        told = json.loads(line)
    except ValueError:
        return blanked(line)
    return json.dumps(blanked_doc(told), ensure_ascii=False) if isinstance(told, dict | list) else blanked(line)


def _holds(key: str, value: object) -> bool:
    return _KEY.search(key) is not None and value is not None and not isinstance(value, bool) and value != ""
