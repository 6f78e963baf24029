"""JSON Schemas of all files that people write or exchange, generated from the models that check them."""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import BaseModel

from abbe.drivers.device_file import DeviceFile
from abbe.service.config_schema import MachineFile
from abbe.service.domain.artefact import ArtefactRunFile
from abbe.service.domain.discovery_file import DiscoveryFile, StandstillFile
from abbe.service.domain.machine import MachineObject
from abbe.service.domain.run_file import CampaignFile, ErrorsFile, RunFile
from abbe.service.domain.solution_file import SolutionFile

MODELS: dict[str, type[BaseModel]] = {
    "machine-file": MachineFile,
    "device-file": DeviceFile,
    "machine": MachineObject,
    "run": RunFile,
    "artefact-run": ArtefactRunFile,
    "campaign": CampaignFile,
    "errors": ErrorsFile,
    "solution": SolutionFile,
    "discovery": DiscoveryFile,
    "standstill": StandstillFile,
}


def schema_text(name: str) -> str:
    """Return one schema as JSON text, the same at every call; ``name``: a key of `MODELS`."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema"} | MODELS[name].model_json_schema()
    return json.dumps(schema, indent=2, ensure_ascii=False, sort_keys=True) + "\n"


def write_schemas(folder: Path) -> list[Path]:
    """Write all schemas to a folder, created if missing; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.schema.json" for name in MODELS]
    for name, path in zip(MODELS, paths, strict=True):
        path.write_text(schema_text(name), encoding="utf-8", newline="\n")
    return paths
