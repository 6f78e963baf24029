"""Export a stored solution as a control's table files, sign them, and read such files back.

An imported file either has a valid signature for this machine, or is only a candidate.
"""

from __future__ import annotations

import io
import json
import math
import os
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.models.machine import AXES, Machine
from abbe.models.uncertainty.scales import SCALE_TEXTS, Scales, scale_projection
from abbe.service.config_schema import MachineFile
from abbe.service.domain.machine import machine_from_doc
from abbe.service.domain.solution_file import StoredPrediction
from abbe.service.errors import FileFormatError, FormatRefused, SignatureRefused, TableFileError
from abbe.service.files import NotPlainError, read_plain, write_page
from abbe.service.formats.controls import CONTROLS, ControlModel, FormatChoice, best_of, choices, rounded
from abbe.service.formats.files import FormatSettings, TextFile
from abbe.service.formats.identified import Identified
from abbe.service.formats.model import Compensation, negated
from abbe.service.formats.registry import FORMATS, format_of
from abbe.service.signed import keys
from abbe.service.signed.container import LARGEST, NO_BASE, Claims, ExpectedContent, check, claims_of, sign
from abbe.service.site import site_of

LARGEST_FILE, LARGEST_SOLUTION = 20_000_000, 512 << 20
BEYOND = 0.1
"""An export warns if at least this share of a stroke lies beyond the positions of the runs."""
ONLY_FRESH = "the tables assume that no table was active during the measurement: if one was, add its corrections to these tables"


@dataclass(frozen=True)
class Exported:
    """Files for a control, the kinds of tables among which the best was chosen, and notes for people."""

    files: tuple[TextFile, ...]
    choices: tuple[FormatChoice, ...]
    notes: tuple[str, ...]


def scales_badly_known(doc: dict[str, Any]) -> Scales | None:
    """Return the scales if they are the largest part of a stored solution's uncertainty, else None."""
    found = ((doc.get("uncertainty") or {}).get("without_scale") or {}).get("scales")
    return found if found in SCALE_TEXTS else None


def identified(doc: dict[str, Any], *, without_scale: bool = False) -> Identified:
    """The machine of a stored solution (``abbe-solution/1``): geometry, coefficients, lost motion where it was observed.

    ``without_scale``: without the scales that are the largest part of its uncertainty.

    Raises
    ------
    FileFormatError
        The document holds no coefficients, or no machine.
    FormatRefused
        The scales are not the least certain part of the solution.
    """
    for key, what in (("prediction", "coefficients"), ("machine", "machine")):
        if not isinstance(doc.get(key), dict):
            raise FileFormatError(f"the solution holds no {what} (key {key!r})", "solve the campaign again: abbe solve")
    try:
        machine = machine_from_doc(doc["machine"])
        terms, coefficients, _ = StoredPrediction.read(doc["prediction"]).unpacked()
        parameters = doc.get("parameters", {})
        lost = {a: parameters.get(f"backlash_{a}", {}) for a in AXES}
        observed = {a: float(v["value"]) for a, v in lost.items() if v and v["status"] != "not observable"}
    except (ValueError, KeyError, TypeError) as error:
        raise FileFormatError(f"the solution cannot be read: {error}", "solve the campaign again: abbe solve") from None
    if without_scale:
        scales = scales_badly_known(doc)
        if scales is None:
            raise FormatRefused("no scale can be left out: this solution determines the scales as well as the rest", "omit --without-scale")
        coefficients = scale_projection(machine, terms, scales) @ coefficients
    return Identified(machine, terms, coefficients, observed)


def scale_note(doc: dict[str, Any], *, without_scale: bool) -> list[str]:
    """Return lines on uncertain scales in the tables; empty if the solution determines them."""
    scales = scales_badly_known(doc)
    if scales is None:
        return []
    u = doc["uncertainty"]
    text, worst = SCALE_TEXTS[scales], u["worst_point"]["expanded_vector_um"]
    rest = f"the rest is known to ± {u['without_scale']['expanded_vector_um']:.2g} µm at the worst"
    if without_scale:
        return [f"{text}: left out, and not corrected; {rest}"]
    with_it = f"with it, everything is known to ± {worst:.2g} µm at the worst"
    return [f"{text}: written, but poorly determined by these runs; {with_it}; {rest}; --without-scale leaves it out"]


def reach_note(doc: dict[str, Any]) -> list[str]:
    """Return lines on ends of axes that no run reached, if more than a tenth of the stroke: there the tables are assumptions."""
    machine, notes = machine_from_doc(doc["machine"]), []
    for (axis, (low, high)), (first, last) in zip(doc.get("reached_mm", {}).items(), machine.stroke_mm, strict=False):
        beyond = max(low - first, last - high) / (last - first)
        if beyond > BEYOND:
            notes.append(
                f"no run reached {axis} below {low:.0f} or above {high:.0f} mm of its stroke {first:.0f} to {last:.0f} mm: what the tables "
                "correct there is assumed, not measured"
            )
    return notes


def solution_document(source: Path) -> dict[str, Any]:
    """Read a solution from a JSON file (`abbe solve --json`).

    Raises
    ------
    FileFormatError
        The file cannot be read or is not a JSON object.
    """
    try:
        doc = json.loads(read_plain(source, LARGEST_SOLUTION))
    except OSError as error:
        raise FileFormatError(f"{source}: cannot be read: {error.strerror}", "give the number of a solution or a file") from None
    except UnicodeDecodeError:
        raise FileFormatError(f"{source}: is not UTF-8 text", "give a file of `abbe solve --json`") from None
    except ValueError as error:
        raise FileFormatError(f"{source}: is not JSON: {error}", "give a file of `abbe solve --json`") from None
    if not isinstance(doc, dict):
        raise FileFormatError(f"{source}: is not a JSON object", "give a file of `abbe solve --json`")
    return doc


def control_for(key: str) -> ControlModel:
    """Return the control with this key; for the key of a format, a control that has only this format.

    Raises
    ------
    FormatRefused
        There is no control and no format of this key.
    """
    if key in CONTROLS:
        return CONTROLS[key]
    if key not in FORMATS:
        raise FormatRefused(f"there is no format or control {key!r}", f"formats: {', '.join(FORMATS)}; controls: {', '.join(CONTROLS)}")
    form = FORMATS[key]
    for c in CONTROLS.values():
        if key in (c.own_format, c.lattice_format, c.motions_format, c.lines_format) and c.cross_format in ("", key):
            return replace(c, own_format=key if c.own_format == key else "", lattice_format=key if c.lattice_format == key else "")
    points = min(form.limits.points, 101)
    shared = key if form.limits.cross else ""
    home = next((c for c in CONTROLS.values() if key in (c.own_format, c.cross_format)), ControlModel(key, form.name))
    return replace(
        home,
        key=key,
        name=form.name,
        own_format=key,
        own_points=points,
        cross_format=shared,
        cross_points=min(points, home.cross_points),
        products=form.limits.products,
        both_directions=form.limits.directional,
        tables=None,
    )


def settings_for(control: ControlModel, machine: Machine, reference_mm: F1) -> FormatSettings:
    """Return the settings for writing table files: reference point, decimals that the control's unit needs, and unit for Fanuc."""
    x, y, z = (float(v) for v in reference_mm)
    return FormatSettings(
        reference_mm=(x, y, z),
        decimals=max(3, round(-math.log10(control.unit_mm))),
        machine=machine,
        unit_mm=control.unit_mm if control.unit_mm >= 1e-4 else 1e-3,
    )


STEP_UM, STEP_SHARE = 10.0, 0.2
MOTIONS_ADD_UP = 6.0


def sign_is_turned(step_moved_um: float | None) -> bool | None:
    """Return the result of the 10 µm step: the sign is as written (False) or reversed (True); None if it was not measured.

    Raises
    ------
    FormatRefused
        The axis moved by neither -10 nor +10 µm (within 20 %): axis, unit or scale are wrong.
    """
    if step_moved_um is None:
        return None
    if not abs(abs(step_moved_um) - STEP_UM) <= STEP_SHARE * STEP_UM:
        raise FormatRefused(
            f"the step moved the axis by {step_moved_um:g} µm, neither -10 nor +10: axis, unit or scale differ from the file",
            "load no table; compare the file with one that the control exports",
        )
    return step_moved_um > 0.0


def export(
    known: Identified,
    key: str,
    reference_mm: F1 | None = None,
    *,
    fresh: bool = False,
    holds_at: str = "",
    turned: bool | None = None,
) -> Exported:
    """Return the files of the tables that best correct the machine, of all kinds that a control or format can hold.

    Parameters
    ----------
    key : str
        Key of a format or of a control.
    reference_mm : array, shape (3,), optional
        Where the tables are zero; default: start of every stroke.
    fresh : bool
        No correction was in force while the machine was measured (`abbe.service.tables.measured_with`).
    holds_at : str
        Temperature of the scales at which the solution holds; empty: unknown.
    turned : bool, optional
        Result of the 10 µm step (`sign_is_turned`). It is used only if no manual states the sign of the format.

    Raises
    ------
    FormatRefused
        There is no such format, the tables do not fit it, or no table reduces the errors.
    """
    from abbe.service.verification.reduction import UNKNOWN

    control = control_for(key)
    reference = known.machine.stroke_mm[:, 0] if reference_mm is None else reference_mm
    found = choices(known, control, reference)
    best = best_of(found)
    if best.rms_mm >= found[0].rms_mm:
        raise FormatRefused(f"no kind of table of {control.name} reduces the errors", "the machine needs none; nothing was written")
    files = files_of(best.compensation, control, settings_for(control, known.machine, reference), turned=turned or False)
    return Exported(files, found, (f"holds at: {holds_at or UNKNOWN}", *_notes(best.compensation, control, fresh=fresh, turned=turned)))


def files_of(comp: Compensation, control: ControlModel, settings: FormatSettings, *, turned: bool = False) -> tuple[TextFile, ...]:
    """Write each part of a compensation (own, cross, lattice, motions) in the format that the control uses for it.

    ``turned``: the 10 µm step moved the wrong way; formats whose sign no manual states are written with the other sign.
    """
    own = Compensation(comp.own)
    cross = Compensation(comp.cross, comp.products)
    if control.own_format == control.cross_format:
        own, cross = Compensation(comp.tables, comp.products), Compensation()
    parts = (
        (control.own_format, own),
        (control.cross_format, cross),
        (control.lattice_format, Compensation(lattice=comp.lattice)),
        (control.motions_format, Compensation(motions=comp.motions)),
        (control.lines_format, replace(comp, lost_motion_mm=comp.lost_motion_mm if holds_lost_motion(control) else {})),
    )
    out: list[TextFile] = []
    for key, part in parts:
        if key and (part.numbers or any(part.lost_motion_mm.values())):
            form = format_of(key)
            out += form.write(negated(part) if turned and not form.sign.sure else part, settings)
    return tuple(out)


def _notes(comp: Compensation, control: ControlModel, *, fresh: bool, turned: bool | None) -> tuple[str, ...]:
    out = [] if fresh else [ONLY_FRESH]
    lost = {a: v for a, v in comp.lost_motion_mm.items() if abs(v) > 0.5e-3 * 1e-3}
    if lost and not holds_lost_motion(control):
        values = ", ".join(f"{a} {v * 1e3:.2f} µm" for a, v in lost.items())
        out.append(f"lost motion is in no table: set the control's own backlash parameter ({values})")
    for key in formats_in(control):
        form = FORMATS[key]
        out.append(f"{form.name}: {form.sign.evidence}; to activate: {form.live}")
        if form.sign.sure:
            continue
        if turned is not None:
            out.append(f"{form.name}: sign by the measured step: {'opposite to' if turned else 'as in'} docs/reference/formats.md")
        else:
            out.append(
                f"{form.name}: no manual states the sign ({form.sign.text}): write the 10 µm step first and measure it "
                "(docs/reference/formats.md)"
            )
    return tuple(out)


def holds_lost_motion(control: ControlModel) -> bool:
    """Whether the files of a control hold its backlash parameter."""
    return bool(control.lines_format) and control.lost_motion


def expected(known: Identified, control: ControlModel, reference_mm: F1 | None = None) -> Compensation:
    """Return the tables that an export to this control would write, rounded in the same way, without lost motion."""
    reference = known.machine.stroke_mm[:, 0] if reference_mm is None else reference_mm
    comp = best_of(choices(known, control, reference)).compensation
    return replace(rounded(comp, control.unit_mm), lost_motion_mm=comp.lost_motion_mm if holds_lost_motion(control) else {})


def alike_mm(control: ControlModel) -> float:
    """Return the largest difference, mm, that rounding can make between read and expected tables; it adds up over error motions."""
    return (MOTIONS_ADD_UP if control.motions_format else 1.0) * 0.51 * control.unit_mm + 1e-6


def read_key(key: str, files: tuple[TextFile, ...], settings: FormatSettings, *, turned: bool = False) -> Compensation:
    """Read the tables of one format, or of all formats of a control together; ``turned`` as in `files_of`.

    Raises
    ------
    TableFileError
        The control could not read some part of a file, or no file has one of its formats.
    """
    control = control_for(key)
    tables: list[Any] = []
    out = Compensation()
    names = formats_in(control)
    for name in names:
        own_files = files if len(names) == 1 else tuple(f for f in files if belongs(f, name))
        if not own_files:
            continue
        form = format_of(name)
        part = form.read(own_files, settings)
        part = negated(part) if turned and not form.sign.sure else part
        tables += part.tables
        out = replace(
            out,
            products=out.products + part.products,
            lattice=out.lattice or part.lattice,
            motions=out.motions or part.motions,
            lost_motion_mm={**out.lost_motion_mm, **part.lost_motion_mm},
        )
    if not (tables or out.products or out.lattice or out.motions or out.lost_motion_mm):
        given = ", ".join(f.name for f in files[:3]) + (f" and {len(files) - 3} more" if len(files) > 3 else "")
        raise TableFileError(f"{given}: none of the files belongs to {control.name}", "give the files of one export")
    return replace(out, tables=tuple(tables))


SUFFIXES = {
    "linuxcnc-1": ".comp",
    "linuxcnc-0": ".comp",
    "linuxcnc-hal": ".hal",
    "siemens-eec": "eec.ini",
    "siemens-cec": "cec.ini",
    "fanuc-pitch": "pitch.txt",
    "fanuc-lattice": "lattice.csv",
}


def belongs(file: TextFile, key: str) -> bool:
    """Whether the name of a file in a control's folder fits this format."""
    return file.name.lower().endswith(SUFFIXES.get(key, ""))


def formats_in(control: ControlModel) -> tuple[str, ...]:
    """Formats that a control reads. Where there are several, file names distinguish them, so the files always go into a folder."""
    return tuple(
        dict.fromkeys(
            k for k in (control.own_format, control.cross_format, control.lattice_format, control.motions_format, control.lines_format) if k
        )
    )


def write_files(files: tuple[TextFile, ...], out: Path, *, folder: bool = False) -> list[Path]:
    """Write one file to ``out``; several files, or any with ``folder``, into a new folder ``out``. An error leaves no folder.

    Raises
    ------
    FileFormatError
        A file cannot be written, or the folder exists.
    """
    if len(files) == 1 and not folder:
        write_page(files[0].text, out)
        return [out]
    if out.exists():
        raise FileFormatError(f"{out}: exists already, and the files need a new folder", "give another name")
    aside: Path | None = None
    try:
        aside = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
        for f in files:
            with (aside / f.name).open("w", encoding="utf-8") as file:
                file.write(f.text)
                file.flush()
                os.fsync(file.fileno())
        aside.chmod(0o755)
        aside.rename(out)
    except OSError as error:
        if aside is not None:
            shutil.rmtree(aside, ignore_errors=True)
        raise FileFormatError(f"{out}: cannot be written: {error.strerror}", "give a writable folder") from None
    return [out / f.name for f in files]


def read_files(path: Path) -> tuple[TextFile, ...]:
    """Read a file, or all files of a folder in order of name.

    Raises
    ------
    FileFormatError
        A file is missing, too large, or no text.
    """
    try:
        paths = sorted(p for p in path.iterdir() if p.is_file() and not p.name.startswith(".")) if path.is_dir() else [path]
        out = []
        for p in paths:
            out.append(TextFile(p.name, io.StringIO(read_plain(p, LARGEST_FILE).decode("utf-8"), None).read()))
    except NotPlainError as error:
        raise FileFormatError(f"{error.filename} is not a compensation table: {error.strerror}", "give the table's file") from None
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read: {error.strerror}", "give a file or a folder") from None
    except UnicodeDecodeError:
        raise FileFormatError(f"{path}: is not text", "give the table's file") from None
    if not out:
        raise FileFormatError(f"{path}: the folder is empty", "give a file or a folder of files")
    return tuple(out)


def reference_of(text: str | None) -> F1 | None:
    """Parse ``"0,-200,-300"`` as positions of X, Y, Z, mm; None gives None.

    Raises
    ------
    FileFormatError
        The text is not three numbers.
    """
    if text is None:
        return None
    try:
        values = np.array([float(v) for v in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if values.size != 3 or not np.isfinite(values).all():
        raise FileFormatError(f"--reference {text!r}: expected three positions, e.g. 0,0,-300", "give X,Y,Z in mm")
    return values


LONGEST_DAYS = 366.0


@dataclass(frozen=True, slots=True)
class SealStatus:
    """The verdict on a signature. ``claims`` None: the files are a candidate, to be compared but never pushed as they are."""

    claims: Claims | None
    why: str

    @property
    def signed(self) -> bool:
        """Whether a trusted person signed everything for this machine and the signature still holds."""
        return self.claims is not None


@dataclass(frozen=True, slots=True)
class SigningRequest:
    """Requirements of an import on a signature.

    ``form``: format of the files; ``trusted``: public keys besides those of the machine file; ``base``: fingerprint of the table that was
    active while measuring, None: any.
    """

    form: str
    trusted: tuple[str, ...] = ()
    base: str | None = None


def signature_file(path: Path) -> Path:
    """Path of the signature, beside its file or folder."""
    return path.with_name(path.name + ".sig")


@dataclass(frozen=True, slots=True)
class TableSeal:
    """Signature of a person: file of the key, days of validity, and fingerprint of the table that was active while measuring."""

    key: Path
    days: float
    base: str = NO_BASE


def check_signing(doc: dict[str, Any], config: MachineFile | None, seal: TableSeal) -> MachineFile:
    """Check, before any file is written, everything that can prevent signing; return the machine file.

    Raises
    ------
    KeyRefused, SignatureRefused
        There is no key or no machine file, the days of validity are out of range, or the solution belongs to another machine.
    """
    keys.read_key(seal.key)
    if config is None:
        raise SignatureRefused("a signature needs a machine, and none is given", "give -m FILE; nothing was written")
    if not 0 < seal.days <= LONGEST_DAYS:
        raise SignatureRefused(f"a signature cannot hold for {seal.days:g} days", f"give more than 0 and at most {LONGEST_DAYS:g} days")
    name = doc["machine"].get("name")
    if name != config.name:
        raise SignatureRefused(
            f"the solution is of machine {name!r}, but the machine file is of {config.name!r}", "give the solution's machine file"
        )
    return config


def sign_files(out: Path, form: str, config: MachineFile, seal: TableSeal, now: datetime) -> Path:
    """Sign the files at ``out``; return the path of the signature.

    Raises
    ------
    KeyRefused, SignatureRefused, FileFormatError
        There is no key, or a file cannot be read or written.
    """
    span = (now, now + timedelta(days=seal.days))
    claims = claims_of(config.name, form, contents(out), seal.base, site_of(config).limits.digest(), span)
    target = signature_file(out)
    write_page(sign(claims, keys.read_key(seal.key)).decode(), target)
    return target


def seal_status(path: Path, read: Sequence[TextFile], config: MachineFile | None, ask: SigningRequest, now: datetime) -> SealStatus:
    """Judge the signature of the files at ``path``, whose text is ``read``.

    Raises
    ------
    SignatureRefused
        The signature is invalid, which is worse than no signature.
    """
    seal = signature_file(path)
    if not seal.exists():
        return SealStatus(None, "not signed")
    if config is None:
        return SealStatus(None, "signed, but the machine is unknown: give -m FILE")
    try:
        sealed = read_plain(seal, LARGEST)
    except NotPlainError as error:
        raise SignatureRefused(f"{seal}: {error.strerror}", "remove the signature: the files are then only a candidate") from None
    except OSError as error:
        raise FileFormatError(
            f"{seal}: cannot be read: {error.strerror}", "make the signature readable, or remove it: the files are then only a candidate"
        ) from None
    expected = ExpectedContent(config.name, site_of(config).limits.digest(), ask.form, [*ask.trusted, *config.signatures.trusted], ask.base)
    found = contents(path)
    claims = check(sealed, found, expected, now)
    if {f.name: f.text for f in read} != {name: io.StringIO(content.decode("utf-8"), None).read() for name, content in found.items()}:
        raise SignatureRefused(f"{path} was changed while it was read", "try again; nothing was imported")
    return SealStatus(claims, f"signed {claims.signed_utc[:16]}, holds until {claims.expiry_utc[:16]} (UTC)")


def contents(path: Path) -> dict[str, bytes]:
    """Names and bytes of a file, or of all files of a folder.

    Raises
    ------
    FileFormatError
        A file cannot be read.
    """
    try:
        paths = sorted(p for p in path.iterdir() if p.is_file() and not p.name.startswith(".")) if path.is_dir() else [path]
        return {p.name: read_plain(p, LARGEST_FILE) for p in paths}
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read: {error.strerror}", "give a file or a folder") from None
