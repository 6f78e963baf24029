"""Lists of an artefact's points as a campaign: CSV files with named columns, one pose each, and reports of plug plates from a CMM.

A CSV file has lines ``# key: value`` (`HEAD`, docs/how-to/artefact.md) above its header. Its columns are those of a run of an artefact and
``nominal_x_mm`` .. of the features; without columns ``deviation_..`` these are computed from the positions that were found.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from abbe.models.arrays import F2
from abbe.service.domain.artefact import ARTEFACT_TEST
from abbe.service.domain.document import Doc
from abbe.service.domain.run import PLACES, Run
from abbe.service.domain.run_file import ASSUMED_MODEL, CAMPAIGN_FORMAT, RUN_FORMAT, CampaignFile
from abbe.service.errors import FileFormatError
from abbe.service.formats.files import TextFile
from abbe.service.instrument_files.campaign import ASSUMED_CHAIN
from abbe.service.instrument_files.content import read_bytes, text_file
from abbe.service.runs.checks import check, check_run
from abbe.service.runs.exchange import FolderContent

HEAD = (
    "artefact", "kind", "source", "tool_mm", "origin_mm", "rotation_deg", "expansion_per_K", "u_expansion_per_K", "temperature_C",
    "calibrated_length", "U_mm", "U_per_m_mm", "u_mm",
)  # fmt: skip
"""Keys above the header of a CSV file. ``rotation_deg``: about x, then y, then z of the machine; ``calibrated_length``: from, to,
mm, U mm."""
PLATE = re.compile(r"\s*Plug Plate:\s*(\S+)")
PLATE_NAMES = "Meas X    Meas Y     Nom X     Nom Y"
PLATE_HEAD: Mapping[str, str] = {
    "kind": "workpiece",
    "source": "workpiece-on-cmm",
    "U_mm": "0.0025",
    "U_per_m_mm": "0.005",
    "u_mm": "0.001",
}
"""What a report of a plug plate does not say: usual figures of a CMM, assumed."""
POINT_S = 6.0
"""Time from point to point where a file has none, and between two poses ten times as much."""
NOMINAL = tuple(f"nominal_{a}_mm" for a in "xyz")
FOUND = tuple(f"deviation_{a}_mm" for a in "xyz")


@dataclass(frozen=True)
class PointList:
    """One file: its head by key (several values of ``calibrated_length``), and its columns as text."""

    name: str
    head: Mapping[str, str]
    columns: Mapping[str, list[str]]
    lengths: list[str] = field(default_factory=list)


def is_point_list(path: Path) -> bool:
    """Whether a file is a list of an artefact's points, by its first lines."""
    if path.suffix.lower() not in ("", ".csv", ".txt") or not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(4096).decode("utf-8", errors="replace")
    rows = [line for line in start.splitlines() if line.strip() and not line.startswith("#")]
    return bool(PLATE.match(start)) or bool(rows and {"feature", *NOMINAL[:2]} <= set(rows[0].replace(" ", "").split(",")))


def campaign_of_points(paths: Sequence[Path], name: str, machine: Doc | None) -> FolderContent:
    """Make one campaign of lists of points of one machine; without ``machine`` chain and strokes are assumed.

    Raises
    ------
    FileFormatError
        A file has a mistake; the message has file and line.
    """
    lists = [_read(text_file(path.name, read_bytes(path))) for path in paths]
    artefacts, runs, start = dict[str, Doc](), list[Doc](), 0.0
    for number, one in enumerate(lists, start=1):
        columns = _columns(one, start)
        start = columns["t_s"][-1] + 10.0 * POINT_S
        runs.append(_run(one, name, f"p{number}", columns))
        found, known = _artefact(one), artefacts.get(runs[-1]["setup"]["artefact"])
        features = {f["id"]: f for f in [*(known["features"] if known else []), *found["features"]]}
        lengths = [*(known["calibrated_lengths"] if known else []), *found["calibrated_lengths"]]
        artefacts[runs[-1]["setup"]["artefact"]] = found | {"features": list(features.values()), "calibrated_lengths": lengths}
    made = machine or _assumed(runs)
    runs = [run | {"machine": made} for run in runs]
    cmm = {key: float(one.head[key]) for one in lists for key in ("U_mm", "U_per_m_mm") if key in one.head}
    document = {
        "format": CAMPAIGN_FORMAT, "campaign": name, "machine": made, "current_model": {"includes": list(ASSUMED_MODEL), "errors": None},
        "instruments": {"cmm": cmm | {"k": 2}} if cmm else {"probe": {}},
        "setups": {r["run_id"]: {"kind": "artefact", "t_set_s": r["setup"]["t_set_s"]} for r in runs},
        "temperature_sensors": False, "artefacts": artefacts,
        "runs": [{key: r[key] for key in ("run_id", "test", "role")} | {"file": f"{r['run_id']}.json"} for r in runs],
    }  # fmt: skip
    for run in runs:
        check_run(Path(f"{run['run_id']}.json"), run)
    check(Path("campaign.json"), document, CampaignFile)
    return FolderContent(document, runs, [Run.from_document(run).with_artefact(document) for run in runs], None, {})


def _read(file: TextFile) -> PointList:
    lines = list(file.lines())
    plate = next((m for _, text in lines[:5] if (m := PLATE.match(text))), None)
    return _plug_plate(file, lines, plate.group(1)) if plate else _table(file, lines)


def _plug_plate(file: TextFile, lines: list[tuple[int, str]], plate: str) -> PointList:
    """Read the columns Meas X, Meas Y, Nom X, Nom Y of a plug plate; a hole is named by its number."""
    rows = [(n, text.split()) for n, text in lines if len(text.split()) >= 6 and text.split()[0].lstrip("-")[:1].isdigit()]
    if len(rows) < 3:
        raise FileFormatError(f"{file.name}: {len(rows)} rows of {PLATE_NAMES!r}, expected three or more", "give the whole report")
    values = np.array([[file.number(n, word, "a position") for word in row[:4]] for n, row in rows])
    text = [[repr(float(v)) for v in column] for column in values.T]
    zero = ["0.0"] * len(rows)
    deviation = {f"deviation_{a}_mm": [f"{v:.6g}" for v in values[:, k] - values[:, 2 + k]] for k, a in enumerate("xy")}
    places = dict(zip((*NOMINAL, *PLACES), (text[2], text[3], zero, text[2], text[3], zero), strict=True))
    columns = {"feature": [f"H{i:03d}" for i in range(1, len(rows) + 1)]} | places | deviation
    return PointList(file.name, {"artefact": plate, **PLATE_HEAD}, columns)


def _table(file: TextFile, lines: list[tuple[int, str]]) -> PointList:
    head, lengths = _head(file, [(n, text) for n, text in lines if text.startswith("#")])
    rows = [(n, [word.strip() for word in next(csv.reader([text]))]) for n, text in lines if text.strip() and not text.startswith("#")]
    names = rows[0][1]
    for key in ("feature", *NOMINAL[:2], *PLACES):
        if key not in names:
            raise file.wrong(rows[0][0], f"column {key!r} is missing", "add it; docs/how-to/artefact.md has an example")
    for n, row in rows[1:]:
        if len(row) != len(names):
            raise file.wrong(n, f"{len(row)} values for {len(names)} columns", "correct the row")
        for key, word in zip(names, row, strict=True):
            if key != "feature" and word:
                file.number(n, word, key)
    return PointList(file.name, head, {key: [row[i] for _, row in rows[1:]] for i, key in enumerate(names)}, lengths)


def _head(file: TextFile, lines: list[tuple[int, str]]) -> tuple[dict[str, str], list[str]]:
    """Keys and values of the lines above the header, and the calibrated lengths."""
    head, lengths = dict[str, str](), list[str]()
    for n, text in lines:
        key, colon, value = (part.strip() for part in text.lstrip("# ").partition(":"))
        if colon and key not in HEAD:
            raise file.wrong(n, f"unknown key {key!r}, expected one of {', '.join(HEAD)}", "correct or remove the line")
        lengths += [value] if key == "calibrated_length" else []
        head |= {key: value} if colon else {}
    return head, lengths


def _vector(one: PointList, key: str, usual: str) -> list[float]:
    words = one.head.get(key, usual).replace(",", " ").split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != 3:
        raise FileFormatError(f"{one.name}: {key}: expected three numbers, got {one.head.get(key)!r}", "correct the line")
    return values


def _matrix(one: PointList) -> F2:
    turns = one.head.get("rotation_deg", "0").replace(",", " ").split()
    turns = ["0", "0", turns[0]] if len(turns) == 1 else turns
    matrix: F2 = scipy.spatial.transform.Rotation.from_euler("xyz", [float(v) for v in turns], degrees=True).as_matrix()
    return np.round(matrix, 12) + 0.0


def _columns(one: PointList, start_s: float) -> dict[str, Any]:
    """Columns of the run; a missing one is computed or assumed."""
    n = len(one.columns["feature"])
    out: dict[str, Any] = {"t_s": [start_s + POINT_S * (i + 1) for i in range(n)]}
    for key, words in one.columns.items():
        if key not in NOMINAL:
            out[key] = words if key == "feature" else [float(word) if word else None for word in words]
    if not any(key in one.columns for key in FOUND):
        nominal = _nominal(one)
        found = np.array([out[key] for key in PLACES], dtype=np.float64).T
        deviation = (found - _vector(one, "origin_mm", "0 0 0")) @ _matrix(one) - nominal
        out |= {key: np.round(deviation[:, k], 7).tolist() for k, key in enumerate(FOUND)}
    out |= {key: [None] * n for key in FOUND if key not in out}
    out.setdefault("u_mm", [float(one.head.get("u_mm", "0.001"))] * n)
    if "temperature_C" in one.head:
        out.setdefault("temperature_C", [float(one.head["temperature_C"])] * n)
    return out


def _nominal(one: PointList) -> F2:
    zero = ["0"] * len(one.columns["feature"])
    return np.array([[float(v) for v in one.columns.get(key, zero)] for key in NOMINAL]).T


def _run(one: PointList, campaign: str, label: str, columns: dict[str, Any]) -> Doc:
    pose = {"origin_mm": _vector(one, "origin_mm", "0 0 0"), "matrix": _matrix(one).tolist()}
    setup = {
        "setup_id": label, "t_set_s": columns["t_s"][0], "artefact": one.head.get("artefact", "A"),
        "source": one.head.get("source", "machine-probe"), "tool_mm": _vector(one, "tool_mm", "0 0 0"), "pose": pose,
    }  # fmt: skip
    return {"format": RUN_FORMAT, "campaign": campaign, "run_id": label, "test": ARTEFACT_TEST, "role": "identify"} | {
        "machine": {}, "setup": setup, "columns": columns,
    }  # fmt: skip


def _artefact(one: PointList) -> Doc:
    sensed = "".join(a for a in "xyz" if any(one.columns.get(f"deviation_{a}_mm", [])) or not any(k in one.columns for k in FOUND))
    places = dict(zip(one.columns["feature"], _nominal(one).tolist(), strict=True))
    lengths = []
    for text in one.lengths:
        words = text.replace(",", " ").split()
        if len(words) != 4:
            raise FileFormatError(f"{one.name}: calibrated_length: expected 'from to mm U_mm', got {text!r}", "correct the line")
        lengths.append({"from": words[0], "to": words[1], "length_mm": float(words[2]), "U_mm": float(words[3]), "k": 2})
    numbers = {key: float(one.head[key]) for key in ("expansion_per_K", "u_expansion_per_K") if key in one.head}
    features = [{"id": name, "nominal_mm": place, "sensed": sensed} for name, place in places.items()]
    return {"kind": one.head.get("kind", "plate"), "features": features, "calibrated_lengths": lengths} | numbers


def _assumed(runs: Sequence[Doc]) -> Doc:
    stroke = {}
    for axis, key in zip("XYZ", PLACES, strict=True):
        places = [v for run in runs for v in run["columns"][key]]
        stroke[axis] = [min(places) - 1.0, max(places) + 1.0]
    return {"name": "unknown machine", "chain": ASSUMED_CHAIN, "vertical_axis": "Z", "stroke_mm": stroke}
