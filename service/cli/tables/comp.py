"""`abbe comp`: convert compensation tables to and from the files of controls."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from abbe.service.cli.common import (
    DbOption,
    JsonOption,
    MachineOption,
    check_inputs,
    conclude,
    database_url,
    named_machine,
    open_store,
    print_json,
    print_table,
)

if TYPE_CHECKING:
    from abbe.service.config_schema import MachineFile
    from abbe.service.formats.controls import FormatChoice
    from abbe.service.formats.model import Compensation

comp = typer.Typer(help="Compensation tables: files of controls, proposals, pushes and rollbacks.", no_args_is_help=True)

FormatOption = Annotated[
    str, typer.Option("--format", metavar="F", help="Format or control; abbe comp formats lists them.", show_default=False)
]
ReferenceOption = Annotated[
    str | None,
    typer.Option(
        "--reference", metavar="X,Y,Z", help="Point at which all tables are zero, mm. Default: start of each stroke.", show_default=False
    ),
]


StepOption = Annotated[
    float | None,
    typer.Option(
        "--step-moved",
        metavar="UM",
        help="By how much the axis moved when the 10 µm step was loaded, µm: -10 confirms the sign, 10 reverses it.",
        show_default=False,
    ),
]


@comp.command("formats")
def list_formats(as_json: JsonOption = False) -> None:
    """List formats and controls: what each can hold, and how the sign of its values is known."""
    from abbe.service.formats.controls import CONTROLS
    from abbe.service.formats.registry import FORMATS

    rows = [(f.key, f.name, _holds(f.limits), str(f.limits.points), f.sign.evidence, f.sign.text) for f in FORMATS.values()]
    if as_json:
        keys = ("format", "name", "holds", "points", "evidence", "sign")
        print_json({"formats": [dict(zip(keys, r, strict=True)) for r in rows], "controls": {c.key: c.name for c in CONTROLS.values()}})
        return
    print_table(("format", "what", "holds", "points", "evidence", "sign"), rows)
    print_table(("control", "what"), [(c.key, c.name) for c in CONTROLS.values()])
    conclude("abbe runs", verdict=f"{len(FORMATS)} formats, {len(CONTROLS)} controls")


@comp.command("export")
def export_tables(  # noqa: PLR0913 - one argument for each option
    solution: Annotated[
        str, typer.Argument(metavar="SOLUTION", help="Number of a stored solution, or a file of abbe solve --json.", show_default=False)
    ],
    form: FormatOption,
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="File; a new folder if the format has several files.", show_default=False)
    ],
    reference: ReferenceOption = None,
    step_moved: StepOption = None,
    without_table: Annotated[
        bool, typer.Option("--without-table", help="I know that no correction was in force while this was measured.")
    ] = False,
    without_scale: Annotated[bool, typer.Option("--without-scale", help="Leave out scales that the runs determine poorly.")] = False,
    sign: Annotated[
        Path | None,
        typer.Option("--sign", metavar="KEY", help="Private key that signs for this machine; writes FILE.sig.", show_default=False),
    ] = None,
    days: Annotated[float, typer.Option("--days", help="With --sign: days in which the files may be imported.")] = 30.0,
    base: Annotated[str, typer.Option("--base", help="With --sign: fingerprint of the table that was active while measuring.")] = "none",
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write the best tables that a control can hold, and show the error that each kind of table would leave."""
    doc = _solution(solution, db, machine)

    from abbe.service.clock import SystemClock
    from abbe.service.compensation.comp_export import (
        TableSeal,
        check_signing,
        control_for,
        export,
        formats_in,
        identified,
        reach_note,
        reference_of,
        scale_note,
        sign_files,
        sign_is_turned,
        write_files,
    )

    known = identified(doc, without_scale=without_scale)
    seal = None if sign is None else TableSeal(sign, days, base)
    config = None if seal is None else check_signing(doc, _machine_file(machine), seal)
    fresh = _fresh(solution, db, machine, confirmed_none=without_table)
    made = export(known, form, reference_of(reference), fresh=fresh, holds_at=doc.get("holds_at") or "", turned=sign_is_turned(step_moved))
    notes = [*made.notes, *scale_note(doc, without_scale=without_scale), *reach_note(doc)]
    written = [str(p) for p in write_files(made.files, out, folder=len(formats_in(control_for(form))) > 1)]
    if seal is not None and config is not None:
        written.append(str(sign_files(out, form, config, seal, SystemClock().utc())))
    if as_json:
        print_json({"files": written, "choices": [_choice(c) for c in made.choices], "notes": notes})
        return
    headings = ("tables", "left: rms (µm)", "largest (µm)", "numbers", "")
    rows = [(c.kind, f"{c.rms_mm * 1e3:.2f}", f"{c.max_mm * 1e3:.2f}", str(c.numbers), "written" if c.best else "") for c in made.choices]
    print_table(headings, rows, title="identified error that is left over the volume, both directions, rigid motion removed")
    for note in notes:
        typer.echo(f"- {note}")
    typer.echo(f"wrote {', '.join(written)}")
    conclude(f"abbe comp import {quote(str(out))} --format {form} --solution {quote(solution)}", machine=machine, db=db)


@comp.command("step")
def write_step(
    form: FormatOption,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="File; a new folder if the format has several.", show_default=False)],
    axis: Annotated[str, typer.Option("--axis", help="Axis that is tested.")] = "X",
    reference: ReferenceOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write the 10 µm step of a format, the test before any real table is loaded, and print its place and expected reading."""
    from abbe.models.machine import AXES
    from abbe.service.errors import FormatRefused
    from abbe.service.formats.registry import format_of

    if axis not in AXES:
        raise FormatRefused(f"--axis {axis!r}: expected X, Y or Z", "name the axis that is tested")
    format_of(form)

    from abbe.service.compensation.comp_export import control_for, reference_of, settings_for, write_files
    from abbe.service.formats.step import step_of

    found, nominal, at = format_of(form), _machine(machine), reference_of(reference)
    start = nominal.stroke_mm[:, 0] if at is None else at
    step = step_of(found, nominal, AXES.index(axis), start)
    settings = settings_for(control_for(form), nominal, start)
    written = [str(p) for p in write_files(found.write(step.compensation, settings), out)]
    if as_json:
        print_json({"files": written, "place": step.place, "expected": step.expected})
        return
    typer.echo(f"wrote {', '.join(written)}\nload it instead of every other table; {step.place}: {step.expected}")
    typer.echo(
        "if it moves the other way and no manual states the sign: abbe comp export --step-moved 10; if it "
        "moves by another amount: load no table"
    )
    conclude(f"abbe comp export SOLUTION --format {form} --step-moved -10 --out tables", machine=machine)


@comp.command("import")
def import_tables(  # noqa: PLR0913 - one argument for each option
    file: Annotated[Path, typer.Argument(metavar="FILE", help="File, or folder with several files.", show_default=False)],
    form: FormatOption,
    solution: Annotated[
        str | None, typer.Option("--solution", metavar="SOLUTION", help="Compare with the tables of this solution.", show_default=False)
    ] = None,
    reference: ReferenceOption = None,
    step_moved: StepOption = None,
    trust: Annotated[
        list[str] | None,
        typer.Option("--trust", metavar="KEY", help="Public key to trust, besides those of the machine file.", show_default=False),
    ] = None,
    base: Annotated[str | None, typer.Option("--base", help="Fingerprint of the table in force, if known.", show_default=False)] = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Read a control's files as the control would: show the tables, their status (signed for this machine, or only a candidate), and how
    they differ from a solution's.
    """
    check_inputs(file)

    from abbe.service.clock import SystemClock
    from abbe.service.compensation.comp_export import (
        SigningRequest,
        alike_mm,
        control_for,
        expected,
        identified,
        read_files,
        read_key,
        reference_of,
        seal_status,
        settings_for,
        sign_is_turned,
    )
    from abbe.service.formats.compare import check_same

    control, known, at = control_for(form), None, reference_of(reference)
    if solution is not None:
        known = identified(_solution(solution, db, machine))
    nominal = known.machine if known is not None else _machine(machine)
    start = at if at is not None else nominal.stroke_mm[:, 0]
    files = read_files(file)
    status = seal_status(file, files, _machine_file(machine), SigningRequest(form, tuple(trust or ()), base), SystemClock().utc())
    found = read_key(form, files, settings_for(control, nominal, start), turned=sign_is_turned(step_moved) or False)
    doc: dict[str, Any] = {"tables": _tables(found), "status": "signed" if status.signed else "candidate", "why": status.why}
    if known is not None:
        same = check_same(found, expected(known, control, at), alike_mm(control))
        doc["differences_um"] = {d.axis: d.size_mm * 1e3 for d in same}
    if as_json:
        print_json(doc)
        return
    print_table(
        ("table", "points", "from (mm)", "to (mm)", "smallest", "largest", "unit"), [tuple(map(str, t.values())) for t in doc["tables"]]
    )
    typer.echo(f"{doc['status']}: {status.why}")
    if "differences_um" in doc:
        sizes = ", ".join(f"{a} {v:.4f} µm" for a, v in doc["differences_um"].items())
        typer.echo(f"these are the tables of solution {solution}; largest difference: {sizes}")
    conclude("abbe measure --recipe verification", machine=machine)


def _solution(source: str, db: str | None, machine: Path | None) -> dict[str, Any]:
    """Return a solution's document: by its number from the database, or from a file of `abbe solve --json`."""
    if source.isdigit():
        with open_store(database_url(db, machine)) as store:
            return dict(store.solutions.get(int(source)).doc)
    from abbe.service.compensation.comp_export import solution_document

    return solution_document(Path(source))


def _fresh(source: str, db: str | None, machine: Path | None, *, confirmed_none: bool) -> bool:
    """Return whether a solution's runs are known to be measured without a correction; refuse a solution measured with one."""
    from abbe.service.compensation.comp_export import solution_document
    from abbe.service.runs.exchange import no_image
    from abbe.service.tables.measured_with import check_fresh, images_of, stored_tables, tables_of

    if not source.isdigit():
        return check_fresh(tables_of(solution_document(Path(source))), no_image, confirmed_none=confirmed_none)
    with open_store(database_url(db, machine)) as store:
        return check_fresh(stored_tables(store, int(source)), images_of(store), confirmed_none=confirmed_none)


def _machine_file(file: Path | None) -> MachineFile | None:
    """Return the content of the named machine file; None if none is named."""
    from abbe.service.config import load_machine

    found = named_machine(file)
    return None if found is None else load_machine(found).machine


def _machine(file: Path | None) -> Any:
    """Return the nominal geometry of the named machine file; if none is named, a stand-in that only places the reference at zero."""
    import numpy as np

    from abbe.models.machine import Machine
    from abbe.service.config import load_machine
    from abbe.service.site import site_of

    found = named_machine(file)
    if found is not None:
        return site_of(load_machine(found).machine).machine
    return Machine("w-X-Y-b-Z-t", np.array([[0.0, 1.0]] * 3))


def _choice(c: FormatChoice) -> dict[str, Any]:
    return {"kind": c.kind, "rms_um": c.rms_mm * 1e3, "max_um": c.max_mm * 1e3, "numbers": c.numbers, "best": c.best}


def _holds(limits: Any) -> str:
    kinds = ("own", "cross", "products", "lattice", "motions", "lines", "lost_motion")
    possible = [kind.replace("_", " ") for kind in kinds if getattr(limits, kind)]
    return ", ".join(possible) + ("; both directions" if limits.directional and limits.own else "")


def _tables(found: Compensation) -> list[dict[str, Any]]:
    """Return one row per table: its name, number of points, range of positions, smallest and largest correction."""
    import numpy as np

    rows = []
    for t in found.tables:
        ways = [("", t.forward_mm)] if not t.directional else [(", moving in +", t.forward_mm), (", moving in −", t.backward_mm)]
        rows += [_row(f"{t.name}{word}", t.position_mm, v * 1e3, "µm") for word, v in ways]
    for p in found.products:
        rows.append(_row(f"{p.name}: angle", p.angle.position_mm, p.angle.value * 1e6, "µrad"))
        rows.append(_row(f"{p.name}: lever", p.lever.position_mm, p.lever.value, "mm"))
    if found.lattice is not None:
        for a, axis in enumerate("XYZ"):
            rows.append(_row(f"3-D grid, {axis}", found.lattice.position_mm[a], found.lattice.correction_mm[..., a] * 1e3, "µm"))
    if found.motions is not None:
        for name, c in found.motions.curves.items():
            angle = name[1] in "ABC"
            rows.append(_row(f"error motion {name}", c.position_mm, c.value * (1e6 if angle else 1e3), "µrad" if angle else "µm"))
    return rows + [_row(f"lost motion of {a}", np.zeros(1), np.array([v * 1e3]), "µm") for a, v in found.lost_motion_mm.items()]


def _row(name: str, position: Any, value: Any, unit: str) -> dict[str, Any]:
    return {
        "table": name,
        "points": int(position.size),
        "from_mm": float(position[0]),
        "to_mm": float(position[-1]),
        "smallest": round(float(value.min()), 4),
        "largest": round(float(value.max()), 4),
        "unit": unit,
    }
