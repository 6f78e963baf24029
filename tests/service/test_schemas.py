"""The committed JSON Schemas are those of the program, and the shared examples keep to them."""

from __future__ import annotations

import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from abbe.drivers.device_file import BUILTIN
from abbe.service.schemas import MODELS, schema_text

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "schemas"
TYPES: dict[str, Any] = {"object": dict, "array": list, "string": str, "boolean": bool, "null": type(None)}


@pytest.mark.parametrize("name", sorted(MODELS))
def test_committed_schema_is_up_to_date(name: str) -> None:
    text = (FOLDER / f"{name}.schema.json").read_text(encoding="utf-8")
    assert text == schema_text(name), "run `abbe schema` and commit docs/schemas"


def is_type(name: str, value: Any) -> bool:
    if name in {"number", "integer"}:
        return isinstance(value, int | float) and not isinstance(value, bool) and (name == "number" or float(value).is_integer())
    return isinstance(value, TYPES[name])


def mistakes(value: Any, schema: dict[str, Any], root: dict[str, Any], at: str = "") -> list[str]:
    """A JSON Schema validator for the keywords that pydantic uses."""
    if "$ref" in schema:
        return mistakes(value, root["$defs"][schema["$ref"].rpartition("/")[2]], root, at)
    for union in ("anyOf", "oneOf"):
        if union in schema:
            return [] if [] in [mistakes(value, branch, root, at) for branch in schema[union]] else [f"{at}: {union}"]
    if "type" in schema and not is_type(schema["type"], value):
        return [f"{at}: not {schema['type']}"]
    out = [f"{at}: {keyword}" for keyword, good in scalar_checks(value, schema) if not good]
    if isinstance(value, list):
        parts = schema.get("prefixItems", [])
        rules = parts + [schema.get("items", {})] * (len(value) - len(parts))
        out += [one for index, inner in enumerate(value) for one in mistakes(inner, rules[index], root, f"{at}[{index}]")]
    if isinstance(value, dict):
        out += [f"{at}: no {key}" for key in schema.get("required", []) if key not in value]
        for key, inner in value.items():
            rule = schema.get("properties", {}).get(key, schema.get("additionalProperties", True))
            out += [f"{at}.{key} unknown"] if rule is False else mistakes(inner, {} if rule is True else rule, root, f"{at}.{key}")
    return out


def scalar_checks(value: Any, schema: dict[str, Any]) -> list[tuple[str, bool]]:
    found = [("const", value == schema.get("const", value)), ("enum", value in schema.get("enum", [value]))]
    if isinstance(value, str):
        found += [
            ("pattern", re.search(schema.get("pattern", ""), value) is not None),
            ("minLength", len(value) >= schema.get("minLength", 0)),
        ]
    if isinstance(value, int | float):
        found.append(("exclusiveMinimum", value > schema.get("exclusiveMinimum", -math.inf)))
    if isinstance(value, list):
        found.append(("length", schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value))))
    return found


def check(name: str, document: Any) -> list[str]:
    schema = json.loads((FOLDER / f"{name}.schema.json").read_text(encoding="utf-8"))
    return mistakes(document, schema, schema)


def test_shared_examples_validate(shared: Path) -> None:
    folders = sorted((shared / "data" / "axis-tests").iterdir())
    assert folders
    for folder in folders:
        for path in sorted(folder.iterdir()):
            document = json.loads(path.read_text(encoding="utf-8"))
            assert check("campaign" if path.name == "campaign.json" else "run", document) == []
            assert check("machine", document["machine"]) == []


def test_own_examples_validate(campaign_folder: Path) -> None:
    for path in campaign_folder.iterdir():
        name = {"campaign.json": "campaign", "errors.json": "errors"}.get(path.name, "run")
        assert check(name, json.loads(path.read_text(encoding="utf-8"))) == []


def test_schemas_refuse_what_is_wrong(campaign_folder: Path) -> None:
    run = json.loads((campaign_folder / "r01-x.json").read_text(encoding="utf-8"))
    run["test"] = "nonsense"
    run["columns"]["x_mm"][0] = "1"
    del run["role"]
    run["machine"]["stroke_mm"]["X"] = [1]
    assert len(check("run", run)) == 4


def test_machine_file_schema_refuses_unknown_keys() -> None:
    stroke = {axis: [0, 1] for axis in "XYZ"}
    assert check("machine-file", {"name": "m", "chain": "w-X-Y-b-Z-t", "stroke_mm": stroke}) == []
    assert check("machine-file", {"name": "m", "chain": "w-X-Y-b-Z-t", "stroke_mm": stroke, "x": 1}) == [".x unknown"]


@pytest.mark.parametrize("path", sorted(BUILTIN.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_device_files_keep_to_the_published_schema(path: Path) -> None:
    schema = json.loads((FOLDER / "device-file.schema.json").read_text())
    assert mistakes(tomllib.loads(path.read_text()), schema, schema) == []
