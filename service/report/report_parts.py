"""Parts of every report: machine, instruments with certificates, conditions, provenance of the data, and verdicts."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from abbe.service.campaign_data.provenance import run_digest, versions
from abbe.service.domain.document import Doc
from abbe.service.domain.machine import Rules
from abbe.service.domain.run import Run
from abbe.service.domain.verification import Verdict
from abbe.service.rendering.document import Instrument, ReportFigure, Sign
from abbe.service.rendering.numbers import finite, plain, tidy
from abbe.service.verification.verify import judge, overall

NAMES = {"ballbar": "telescoping ball-bar", "laser": "laser displacement meter"}
SIGNS: Mapping[Verdict, tuple[Sign, str]] = {
    "pass": ("ok", "Within limits"),
    "fail": ("bad", "Out of limits"),
    "cannot tell": ("open", "Cannot tell"),
}
VERIFICATION = "verification"
VERIFICATION_STATEMENT = (
    "U of verification figures includes noise, wavelength and, for the helix, remounting of the bar, but not the temperature of the "
    "scales: they compare one machine with itself. ISO 230-6 figures of the same diagonals include it, so their U is larger."
)
SENSORS = (
    ("temp_air_C", "air temperature", "°C"),
    ("temp_x_C", "temperature of X", "°C"),
    ("temp_y_C", "temperature of Y", "°C"),
    ("temp_z_C", "temperature of Z", "°C"),
    ("temp_spindle_C", "temperature of the spindle", "°C"),
    ("pressure_air_Pa", "air pressure", "Pa"),
)


def machine_facts(machine: Doc) -> dict[str, str]:
    """Head of the report: machine and geometry."""
    strokes = "; ".join(f"{a} {tidy(float(lo))} to {tidy(float(hi))} mm" for a, (lo, hi) in machine["stroke_mm"].items())
    out = {"Machine": str(machine.get("name", "")), "Chain": str(machine["chain"]), "Strokes": strokes}
    tool = machine.get("tool_mm")
    return out if not tool else out | {"Tool": ", ".join(tidy(float(v)) for v in tool) + " mm"}


def instruments(runs: Sequence[Run], campaign: Doc, rules: Rules) -> list[Instrument]:
    """Instruments used in these runs."""
    kinds = {r.instrument for r in runs}
    return [Instrument(NAMES[k], _certificate(k, rules), _known(k, runs, campaign)) for k in NAMES if k in kinds]


def _certificate(kind: str, rules: Rules) -> str:
    if rules.calibrated_until is None:
        return "not in the data: a machine file (-m) states it"
    day, known = rules.calibrated_until.get(kind), rules.instruments.get(kind, "")
    valid = "none stated in the machine file" if day is None else f"valid to {day.isoformat()}"
    return f"{known}; {valid}" if known else valid


def _known(kind: str, runs: Sequence[Run], campaign: Doc) -> str:
    facts = []
    resolution = ((campaign.get("instruments") or {}).get(kind) or {}).get("resolution_mm")
    if resolution is not None:
        facts.append(f"resolution {plain(float(resolution) * 1e3, 2)} µm")
    if kind == "ballbar":
        bars = {(r.bar.length_calibrated, r.bar.u_length_mm) for r in runs if r.is_bar}
        for calibrated, u in sorted(bars, key=repr):
            if calibrated:
                facts.append("length calibrated" + ("" if u is None else f", standard uncertainty {plain(u * 1e3, 2)} µm"))
            else:
                facts.append("length not calibrated")
    return "; ".join(facts) or "nothing stated"


def conditions(runs: Sequence[Run], rules: Rules) -> tuple[dict[str, str], list[str]]:
    """Conditions as text, and remarks about them."""
    out, remarks = {}, []
    further = [r.columns.further for r in runs]
    for column, name, unit in SENSORS:
        read = [float(v) for columns in further for v in columns.get(column, ()) if np.isfinite(v)]
        if read:
            out[name[0].upper() + name[1:]] = f"{min(read):.2f} to {max(read):.2f} {unit}"
            if column == "temp_air_C" and rules.temperature_c is not None:
                low, high = rules.temperature_c
                out["Allowed"] = f"{low:g} to {high:g} °C"
                if min(read) < low or max(read) > high:
                    remarks.append(f"the air was outside the allowed {low:g} to {high:g} °C: the figures cannot be judged")
    if not any(name.startswith("temp") and values.size for columns in further for name, values in columns.items()):
        remarks.append("no run records a temperature")
    feeds = [float(v) for r in runs for v in r.columns.feed_mm_min if v > 0.0]  # 0: not known
    if feeds:
        out["Feed"] = f"{min(feeds):.0f} to {max(feeds):.0f} mm/min" if min(feeds) != max(feeds) else f"{feeds[0]:.0f} mm/min"
    spans = [float(r.columns.t_s[-1] - r.columns.t_s[0]) for r in runs if len(r.columns) and not r.timing.counted]
    if spans:
        out["Time in the runs"] = f"{sum(spans) / 60.0:.1f} min in {len(spans)} runs"
    tables = sorted({f"bank {t.bank}, CRC {t.crc:08X}" for r in runs if (t := r.table).crc is not None and t.bank is not None})
    if tables:
        out["Compensation table in force"] = "; ".join(tables)
    return out, remarks


def data_digest(runs: Sequence[Run]) -> str:
    """SHA-256 over the runs' digests, sorted by name; it changes with any reading."""
    lines = sorted(f"{r.run_id} {run_digest(r)}" for r in runs)
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def doc_digest(value: Any) -> str:
    """SHA-256 of a JSON value in canonical form."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()).hexdigest()


def provenance(digest: str, made: Mapping[str, str] | None = None) -> dict[str, str]:
    """Hash of the data, version of this program, and version of the program that computed the result (``made``), if recorded.

    It has no time stamp, so that equal data give equal reports.
    """
    out = {"Data (SHA-256)": digest}
    if made:
        out |= {f"Result computed by {name}": str(v) for name, v in sorted(made.items())}
    out |= {f"Report by {name}": v for name, v in versions().items()}
    return out | {"Typesetter of the PDF": f"typst {version('typst')}"}


def judged(rows: Mapping[str, tuple[float, float]], rules: Rules, group: str) -> tuple[list[ReportFigure], Verdict | None]:
    """Figures of a verification (from `figure_rows`) with their limits, and the overall verdict on those with a limit."""
    figures, verdicts = [], []
    for key, (value, u) in rows.items():
        limit = rules.limits_um.get(key)
        # A figure without an uncertainty cannot be judged against a limit.
        word: Verdict | None = None if limit is None else judge(value, u, limit) if finite(u) else "cannot tell"
        if word is not None:
            verdicts.append(word)
        symbol, name, method = figure_names(key)
        figures.append(ReportFigure(group, symbol, name, value, u, "µm", method, limit, word or ""))
    return figures, overall(verdicts) if verdicts else None


def figure_names(key: str) -> tuple[str, str, str]:
    """Symbol, name and method of a figure of a verification."""
    if key == "helix_rms_um":
        return "helix rms", "ball-bar on the check helix, rms about its own centre", VERIFICATION
    if key == "body_diagonal_um":
        return "diagonal, worst", "largest range of the bidirectional means of a body diagonal", VERIFICATION
    if key == "reversal_um":
        return "reversal, worst", "largest mean reversal value of a body diagonal", VERIFICATION
    name = key.removeprefix("diagonal_").removesuffix("_um")
    return f"diagonal {name}", f"range of the bidirectional means of body diagonal {name}", VERIFICATION


def verdict_of(found: Verdict | None, remarks: Sequence[str], otherwise: tuple[Sign, str, str]) -> tuple[Sign, str, str]:
    """The verdict by limits. Figures measured outside the allowed temperature are not judged."""
    if found is None:
        return otherwise
    if any("cannot be judged" in r for r in remarks):
        found = "cannot tell"
    sign, word = SIGNS[found]
    return sign, word, "By the limits of the machine file and the decision rule below."
