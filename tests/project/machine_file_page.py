"""Writes docs/reference/machine-file.md from the schema: ``python -m tests.project.machine_file_page`` (``--check``: is it current?)."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from abbe.service.config_schema import MachineFile
from tests.written_page import run

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "machine-file.md"
_HEAD = """# Machine file

`python -m tests.project.machine_file_page` writes this page from the schema (`service/config_schema.py`); a test checks that it is current.
Start with `abbe init` or from `deploy/machine.example.toml`; `abbe check-config` prints the values in force and where each comes from. An
environment variable such as `ABBE_MQTT__URL` replaces a key. An unknown key is an error. Lengths are mm, in the machine's own coordinates.
"""


def page() -> str:
    """The whole page."""
    schema = MachineFile.model_json_schema()
    return _HEAD + "".join(sections(schema, schema, "", schema["description"]))


def sections(schema: dict[str, Any], part: dict[str, Any], name: str, purpose: str) -> Iterator[str]:
    """One table of keys for a section, then those of the sections in it."""
    rows, below = [], []
    for key, value in part["properties"].items():
        inner = _inner(schema, value)
        if inner and {"X", "Y", "Z"} != set(inner["properties"]):
            listed = value.get("type") == "array"
            place = f"{name.strip('[]')}.{key}" if name else key
            place += ".NAME" if "additionalProperties" in value else ""
            below.append((inner, f"[{place}]" if listed else place, value.get("description", inner["description"])))
        else:
            said = value.get("description") or (inner["description"] if inner else "")
            rows.append(f"| `{key}` | {_default(part, key, value)} | {_bounds(value)} | {said} |\n")
    yield f"\n## {f'[{name}]' if name else 'Top of the file'}\n\n{purpose[:1].upper() + purpose[1:]}\n"
    yield "\n| key | default | range | |\n|---|---|---|---|\n" + "".join(rows)
    done: dict[str, str] = {}
    for inner, place, said in below:
        if inner["title"] in done:
            yield f"\n## [{place}]\n\n{said[:1].upper() + said[1:]}: the same keys as [{done[inner['title']]}].\n"
        else:
            yield from sections(schema, inner, place, said)
        done[inner["title"]] = place


def _inner(schema: dict[str, Any], value: dict[str, Any]) -> dict[str, Any] | None:
    """The section that a key holds, or a list of: none where it holds plain values."""
    further = value.get("additionalProperties")
    places = [value, value.get("items", {}), further if isinstance(further, dict) else {}, *value.get("anyOf", [])]
    ref = next((place["$ref"] for place in places if "$ref" in place), None)
    found: dict[str, Any] | None = schema["$defs"][ref.rpartition("/")[2]] if ref else None
    return found


def _default(part: dict[str, Any], key: str, value: dict[str, Any]) -> str:
    if key in part.get("required", ()):
        return "required"
    default = value.get("default")
    return "" if default in (None, "", [], {}) or isinstance(default, dict) else f"`{json.dumps(default)}`"


def _bounds(value: dict[str, Any]) -> str:
    one = next((v for v in value.get("anyOf", [value]) if v.get("type") != "null"), value)
    one = one.get("items", one) if "enum" in one.get("items", {}) else one
    if "enum" in one:
        return ", ".join(f"`{word}`" for word in one["enum"])
    low = f"> {one['exclusiveMinimum']:g}" if "exclusiveMinimum" in one else f"{one['minimum']:g}" if "minimum" in one else ""
    high = f"{one['maximum']:g}" if "maximum" in one else ""
    return f"{low} to {high}" if low and high else low or high


if __name__ == "__main__":
    sys.exit(run(PAGE, page, "tests.project.machine_file_page", __doc__))
