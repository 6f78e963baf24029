"""Lists of an artefact's points as a campaign: CSV files with named columns, one pose each, and reports of plug plates from a CMM.

A CSV file has lines ``# key: value`` (`HEAD`, docs/reference/instrument-files.md) above its header. Its columns are the columns of an
artefact's run, and ``nominal_x_mm`` .. of the features; missing columns ``deviation_..`` are computed from the positions that were found.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from abbe.models.arrays import F2
from abbe.models.geometry.rotation import matrix_zyx
from abbe.service.domain.artefact import ARTEFACT_TEST, MACHINE_PROBE
from abbe.service.domain.document import Doc
from abbe.service.domain.run import PLACES, Columns, Run, RunTiming, parsed_setup
from abbe.service.errors import FileFormatError
from abbe.service.formats.files import TextFile
from abbe.service.instrument_files.campaign import ASSUMED_CHAIN, COUNTED, checked_campaign
from abbe.service.instrument_files.content import read_bytes, text_file
from abbe.service.runs.exchange import FolderContent

HEAD = (
    "artefact", "kind", "source", "tool_mm", "origin_mm", "rotation_deg", "expansion_per_K", "u_expansion_per_K", "temperature_C",
    "calibrated_length", "U_mm", "U_per_m_mm", "u_mm",
)  # fmt: skip
"""Keys above the header of a CSV file. ``rotation_deg``: rotations about x, then y, then z of the machine; ``calibrated_length``: two
features, their distance, mm, and U, mm."""
PLATE = re.compile(r"\s*Plug Plate:\s*(\S+)")
PLATE_NAMES = "Meas X    Meas Y     Nom X     Nom Y"
PLATE_HEAD: Mapping[str, str] = {
    "kind": "workpiece",
    "source": "workpiece-on-cmm",
    "U_mm": "0.0025",
    "U_per_m_mm": "0.005",
    "u_mm": "0.001",
}
"""Usual figures of a CMM, assumed for what a report of a plug plate does not state."""
POINT_S = 6.0
"""Assumed time from point to point, s, if a file states none; ten times as long between two poses."""
NOMINAL = tuple(f"nominal_{a}_mm" for a in "xyz")
FOUND = tuple(f"deviation_{a}_mm" for a in "xyz")


@dataclass(frozen=True)
class PointList:
    """One file: its head by key (several values of ``calibrated_length``), and its columns as text."""

    name: str
    head: Mapping[str, str]
    columns: Mapping[str, list[str]]
    lengths: list[str] = field(default_factory=list)

    @property
    def features(self) -> list[str]:
        """Names of the features, in order."""
        return self.columns["feature"]

    @property
    def artefact(self) -> str:
        """Name of the artefact."""
        return self.head.get("artefact", "A")

    def number(self, key: str, usual: str) -> float:
        """A number of the head."""
        return float(self.head.get(key, usual))


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
    artefacts, all_columns, start = dict[str, KnownArtefact](), list[Columns](), 0.0
    for one in lists:
        all_columns.append(_columns(one, start))
        start = float(all_columns[-1].t_s[-1]) + 10.0 * POINT_S
        found = _artefact(one)
        artefacts[one.artefact] = found.beside(artefacts[one.artefact]) if one.artefact in artefacts else found
    made = machine or _assumed(all_columns)
    runs = [_run(one, name, f"p{k}", made, columns) for k, (one, columns) in enumerate(zip(lists, all_columns, strict=True), start=1)]
    cmm = {key: float(one.head[key]) for one in lists for key in ("U_mm", "U_per_m_mm") if key in one.head}
    instruments = {"cmm": cmm | {"k": 2}} if cmm else {"probe": {}}
    known = {label: artefact.to_document() for label, artefact in artefacts.items()}
    return checked_campaign(name, made, runs, {"instruments": instruments, "artefacts": known})


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
            raise file.wrong(rows[0][0], f"column {key!r} is missing", "add it; docs/reference/instrument-files.md has an example")
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
    return matrix_zyx([float(v) for v in turns])


def _columns(one: PointList, start_s: float) -> Columns:
    """Columns of the run; a missing one is computed or assumed."""
    n = len(one.features)
    out: Doc = {"t_s": [start_s + POINT_S * (i + 1) for i in range(n)]}
    for key, words in one.columns.items():
        if key not in NOMINAL:
            out[key] = words if key == "feature" else [float(word) if word else None for word in words]
    if not any(key in one.columns for key in FOUND):
        nominal = _nominal(one)
        found = np.array([out[key] for key in PLACES], dtype=np.float64).T
        deviation = (found - _vector(one, "origin_mm", "0 0 0")) @ _matrix(one) - nominal
        out |= {key: np.round(deviation[:, k], 7).tolist() for k, key in enumerate(FOUND)}
    out |= {key: [None] * n for key in FOUND if key not in out}
    assumed: Doc = {"u_mm": [one.number("u_mm", "0.001")] * n}
    assumed |= {"temperature_C": [one.number("temperature_C", "")] * n} if "temperature_C" in one.head else {}
    return Columns.from_document(out | {key: values for key, values in assumed.items() if key not in out})


def _nominal(one: PointList) -> F2:
    zero = ["0"] * len(one.features)
    return np.array([[float(v) for v in one.columns.get(key, zero)] for key in NOMINAL]).T


def _run(one: PointList, campaign: str, label: str, machine: Doc, columns: Columns) -> Run:
    pose = {"origin_mm": _vector(one, "origin_mm", "0 0 0"), "matrix": _matrix(one).tolist()}
    setup = {
        "setup_id": label, "t_set_s": float(columns.t_s[0]), "artefact": one.artefact,
        "source": one.head.get("source", MACHINE_PROBE), "tool_mm": _vector(one, "tool_mm", "0 0 0"), "pose": pose,
    }  # fmt: skip
    return Run(
        campaign=campaign, run_id=label, test=ARTEFACT_TEST, role="identify", machine=machine,
        setup=parsed_setup(ARTEFACT_TEST, setup), columns=columns, timing=RunTiming() if "t_s" in one.columns else COUNTED,
    )  # fmt: skip


@dataclass(frozen=True)
class KnownArtefact:
    """What the files state about one artefact; ``features``: by name."""

    kind: str
    features: Mapping[str, Doc]
    lengths: Sequence[Doc]
    numbers: Mapping[str, float]

    def beside(self, earlier: KnownArtefact) -> KnownArtefact:
        """Combine these facts with the facts in earlier files about the same artefact."""
        return replace(self, features={**earlier.features, **self.features}, lengths=[*earlier.lengths, *self.lengths])

    def to_document(self) -> Doc:
        """The artefact in the campaign's document."""
        return {"kind": self.kind, "features": list(self.features.values()), "calibrated_lengths": list(self.lengths), **self.numbers}


def _artefact(one: PointList) -> KnownArtefact:
    sensed = "".join(a for a in "xyz" if any(one.columns.get(f"deviation_{a}_mm", [])) or not any(k in one.columns for k in FOUND))
    places = dict(zip(one.features, _nominal(one).tolist(), strict=True))
    lengths = []
    for text in one.lengths:
        words = text.replace(",", " ").split()
        if len(words) != 4:
            raise FileFormatError(f"{one.name}: calibrated_length: expected 'from to mm U_mm', got {text!r}", "correct the line")
        lengths.append({"from": words[0], "to": words[1], "length_mm": float(words[2]), "U_mm": float(words[3]), "k": 2})
    numbers = {key: float(one.head[key]) for key in ("expansion_per_K", "u_expansion_per_K") if key in one.head}
    features = {name: {"id": name, "nominal_mm": place, "sensed": sensed} for name, place in places.items()}
    return KnownArtefact(one.head.get("kind", "plate"), features, lengths, numbers)


def _assumed(columns: Sequence[Columns]) -> Doc:
    places = np.concatenate([one.q_mm for one in columns])
    ends = zip("XYZ", (places.min(axis=0) - 1.0).tolist(), (places.max(axis=0) + 1.0).tolist(), strict=True)
    stroke = {axis: [low, high] for axis, low, high in ends}
    return {"name": "unknown machine", "chain": ASSUMED_CHAIN, "vertical_axis": "Z", "stroke_mm": stroke}
