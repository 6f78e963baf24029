"""Read and check the machine file, and apply overrides from the environment; every mistake is one line that names the key.

Order of precedence: environment (``ABBE_WEB__PORT=9000`` is ``port`` in ``[web]``), then the file, then the defaults.
"""

from __future__ import annotations

import hashlib
import json
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args, get_type_hints

from pydantic import ValidationError

from abbe.drivers.links.urls import beside
from abbe.service.config_schema import EXCLUSIVE_KEYS, MachineFile
from abbe.service.domain.document import TEXT, WORD
from abbe.service.domain.machine_file import MachineFileSummary, Origin, StatedValue
from abbe.service.errors import ConfigError, Mistake, and_more, location_text, mistakes, nearest
from abbe.service.secrets import mask_secrets
from abbe.service.toml_text import key_lines

PREFIX = "ABBE_"


@dataclass(frozen=True, slots=True)
class LoadedMachine:
    """A machine file with its effective values; ``origins``: dotted key to the source of its value; ``body``: the bytes that were read."""

    path: Path
    machine: MachineFile
    origins: dict[str, Origin]
    body: bytes = field(repr=False)

    @property
    def database_url(self) -> str:
        """``[store] url``; a relative SQLite file lies beside the machine file."""
        from abbe.service.storage.engine import resolve_url

        return resolve_url(self.machine.store.url, self.path.resolve().parent)

    @property
    def sha256(self) -> str:
        """Digest of the file as it was read."""
        return hashlib.sha256(self.body).hexdigest()

    def values(self) -> list[tuple[str, Any, Origin]]:
        """List effective values as (dotted key, value with secrets masked, origin), in the order of the documentation."""
        found = _leaves(self.machine.model_dump(mode="json"))
        return [(key, mask_secrets(value) if isinstance(value, str) else value, self.origins.get(key, "default")) for key, value in found]

    def summary(self) -> MachineFileSummary:
        """The values for the page, with their lines in the file as it was read."""
        lines = key_lines(text_of(self.body))
        stated = tuple(
            StatedValue(key[:WORD], json.dumps(value, ensure_ascii=False)[:TEXT], origin, lines.get(key, 0) if origin == "file" else 0)
            for key, value, origin in self.values()
        )
        return MachineFileSummary(str(self.path.resolve())[:TEXT], self.sha256, stated)


def load_machine(path: Path | str) -> LoadedMachine:
    """Read and check a machine file (TOML).

    Raises
    ------
    ConfigError
        Names file, key, and the expected value.
    """
    path = Path(path)
    return parse_machine(path, _read(path, "machine file"))


def parse_machine(path: Path, body: bytes) -> LoadedMachine:
    """Check the bytes of a machine file that is, or is going to be, at ``path``. Raises ConfigError as `load_machine` does."""
    from_file = _parsed(path, body, "machine file")
    from_environment = _overrides()
    merged = _merged(from_file, from_environment)
    try:
        # Via JSON: there, strict mode refuses text for a number but still accepts a list for a tuple.
        machine = MachineFile.model_validate_json(json.dumps(merged, default=str), strict=True)
    except ValidationError as err:
        raise _config_error(path, mistakes(err.errors()), from_environment) from None
    _check_exclusive(path, merged)
    machine = _with_files(machine, path.resolve().parent)
    origins: dict[str, Origin] = dict.fromkeys((key for key, _ in _leaves(from_file)), "file")
    origins |= dict.fromkeys((key for key, _ in _leaves(from_environment)), "environment")
    return LoadedMachine(path, machine, origins, body)


def _with_files(machine: MachineFile, folder: Path) -> MachineFile:
    """Return the machine file with absolute paths in its device URLs, so that they hold in any working directory."""
    urls = {role: beside(url, folder) for role, url in machine.devices.model_dump().items() if url is not None}
    return machine.model_copy(update={"devices": machine.devices.model_copy(update=urls)})


def _check_exclusive(path: Path, values: Mapping[str, Any]) -> None:
    """Refuse an entry of a list that mixes the keys of its two forms (`EXCLUSIVE_KEYS`), even if a value equals its default."""
    for name, (one, other) in EXCLUSIVE_KEYS.items():
        for number, entry in enumerate(values.get(name, ()), start=1):
            found, more = [key for key in one if key in entry], [key for key in other if key in entry]
            if found and more:
                wanted = f"expected either {' and '.join(one)}, or {', '.join(other)}"
                raise ConfigError(
                    f"{path}: {name}[{number}]: {wanted}, got {', '.join([*found, *more])}", f"remove {more[0]} or {found[0]}"
                )


def read_toml(path: Path, what: str = "machine file") -> dict[str, Any]:
    """Return the content of a machine file, or of another TOML file that ``what`` names in errors.

    Raises
    ------
    ConfigError
        The file is missing, unreadable, not UTF-8 or not TOML; the message says which.
    """
    return _parsed(path, _read(path, what), what)


def _read(path: Path, what: str) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise ConfigError(f"{what} {path} does not exist", "give the path of a machine file, e.g. deploy/machine.toml") from None
    except OSError as err:
        raise ConfigError(f"{what} {path} cannot be read: {err.strerror}", "give a readable TOML file") from None


def _parsed(path: Path, body: bytes, what: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text_of(body))
    except UnicodeDecodeError:
        raise ConfigError(f"{what} {path} is not UTF-8 text", "save it as UTF-8") from None
    except tomllib.TOMLDecodeError as err:
        raise ConfigError(f"{path}: not valid TOML: {err}", "correct this line") from None
    except RecursionError:
        raise ConfigError(f"{path}: nested too deeply", "correct the file") from None
    except ValueError:
        raise ConfigError(f"{path}: an integer has thousands of digits", "correct the file") from None


def text_of(body: bytes) -> str:
    """Return the text of a file with line feeds as its only line ends. Raises UnicodeDecodeError."""
    return body.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")


def _overrides() -> dict[str, Any]:
    """Values of ``ABBE_KEY`` and ``ABBE_TABLE__KEY``. Variables that name no key, such as ABBE_DB, are left out."""
    found: dict[str, Any] = {}
    for name, text in sorted(os.environ.items()):  # ABBE_WEB before ABBE_WEB__PORT
        if not name.upper().startswith(PREFIX):
            continue
        place = _place(name.upper().removeprefix(PREFIX).split("__"))
        if place[0] in MachineFile.model_fields:
            value = _typed(place, text)
            for part in reversed(place):
                value = {part: value}
            found = _merged(found, value)
    return found


def _place(parts: list[str]) -> list[str]:
    """Return the keys that a variable names, spelled as in the file; unknown keys become small letters."""
    place, keys = [], _keys(MachineFile)
    for part in parts:
        place.append(next((key for key in keys if key.upper() == part), part.lower()))
        keys = _keys_inside(keys.get(place[-1]))
    return place


def _typed(place: Sequence[str], text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        if text.startswith(("[", "{")):
            hint = "lists and tables are written as JSON, e.g. ABBE_TOOL_MM='[0,0,120]'"
            raise ConfigError(f"environment: {'.'.join(place)} is not JSON", hint) from None
        return text


def _merged(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    both = {key: _merged(under[key], over[key]) for key in under if isinstance(under.get(key), dict) and isinstance(over.get(key), dict)}
    return {**under, **over, **both}


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{key}.")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for number, inner in enumerate(value, start=1):
                yield from _leaves(inner, f"{prefix}{key}[{number}].")
        else:
            yield prefix + key, value


def _config_error(path: Path, errors: list[Mistake], environment: Mapping[str, Any]) -> ConfigError:
    first, tail = errors[0], and_more(errors)
    location = first.place
    source = f"{PREFIX} environment" if _contains(environment, location) else str(path)
    key = location_text(location)
    if first.unknown_key:
        hint = nearest(str(location[-1]), _siblings(location))
        return ConfigError(f"{source}: unknown key {key!r}{tail}", hint)
    missing = [location_text(one.place) for one in errors if one.kind == "missing" and one.place[:-1] == location[:-1]]
    if first.kind == "missing" and len(missing) > 1:
        names = ", ".join(repr(one) for one in missing)
        return ConfigError(
            f"{source}: keys {names} are missing{and_more(errors[len(missing) - 1 :])}", "add them; `abbe schema` describes every key"
        )
    if first.kind == "missing":
        return ConfigError(f"{source}: key {key!r} is missing{tail}", f"add {location[-1]} = ...")
    wanted = first.expected.replace("expected an object", "expected a table of keys")
    at = f"{source}: {key}" if key else source  # an error of the whole file has no key
    return ConfigError(mask_secrets(f"{at}: {wanted}{tail}"), "correct it; `abbe schema` describes every key")


def _contains(values: Any, location: tuple[int | str, ...]) -> bool:
    for part in location:
        if not isinstance(values, dict) or part not in values:
            return False
        values = values[part]
    return bool(location)


def _siblings(location: tuple[int | str, ...]) -> list[str]:
    keys = _keys(MachineFile)
    for part in location[:-1]:
        if str(part) in keys:
            keys = _keys_inside(keys[str(part)])
    return list(keys)


def _keys_inside(kind: Any) -> dict[str, Any]:
    """Return the keys of a table, of an optional table, or of each table of a list."""
    return next((found for one in (kind, *get_args(kind)) if (found := _keys(one))), {})


def _keys(section: Any) -> dict[str, Any]:
    """Return the keys of a table with their types; nothing for a type that is not a table."""
    names = section.model_fields if hasattr(section, "model_fields") else getattr(section, "__dataclass_fields__", ())
    return {name: kind for name, kind in get_type_hints(section).items() if name in names} if names else {}
