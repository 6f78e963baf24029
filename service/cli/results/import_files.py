"""``abbe import``: a campaign folder, or files of instruments after a preview."""

from __future__ import annotations

import sys
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from abbe.service.cli.common import (
    DbOption,
    JsonOption,
    MachineOption,
    answer,
    check_inputs,
    conclude,
    database_url,
    named_machine,
    open_store,
    print_table,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from abbe.service.instrument_files.answers import Answers, Question
    from abbe.service.instrument_files.campaign import Made
    from abbe.service.instrument_files.columns import ColumnFile
    from abbe.service.instrument_files.content import Content
    from abbe.service.runs.exchange import FolderContent

NOT_STORED = 1


def import_files(  # noqa: PLR0913 - one argument for each option
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...|DIR", help="Files of one machine, or a folder with campaign.json.", show_default=False)
    ],
    yes: Annotated[bool, typer.Option("--yes", help="Store the files without asking.")] = False,
    name: Annotated[
        str | None, typer.Option("--name", help="Name of the campaign. Default: the name of the first file.", show_default=False)
    ] = None,
    columns: Annotated[
        Path | None, typer.Option("--columns", metavar="FILE", help="Description of a table's columns (TOML).", show_default=False)
    ] = None,
    axis: Annotated[
        str | None, typer.Option("--axis", help="Measured axis, for a file that does not state it: X, Y or Z.", show_default=False)
    ] = None,
    unit: Annotated[
        str | None, typer.Option("--unit", help="Unit of the readings, for a file that does not state it: mm, um ...", show_default=False)
    ] = None,
    sign: Annotated[
        str | None,
        typer.Option(
            "--sign",
            help="Sign of the readings, for a file that does not state it: measured-nominal or nominal-measured.",
            show_default=False,
        ),
    ] = None,
    at_mm: Annotated[float | None, typer.Option("--at", help="Where the axis stood during a trace, mm.", show_default=False)] = None,
    scale_c: Annotated[
        float | None, typer.Option("--scale-temperature", help="Temperature of the measured axis' scale, degrees C.", show_default=False)
    ] = None,
    air_c: Annotated[float | None, typer.Option("--air-temperature", help="Air temperature, degrees C.", show_default=False)] = None,
    pressure_hpa: Annotated[float | None, typer.Option("--air-pressure", help="Air pressure, hPa.", show_default=False)] = None,
    feed_mm_min: Annotated[float | None, typer.Option("--feed", help="Feed between the targets, mm/min.", show_default=False)] = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Import a campaign folder, or files of instruments as one campaign after a preview; any mistake leaves the database unchanged.

    Files: .rtl, .rta, .rtx, .pos, .REN, .b5r, and tables (.csv, .tsv, .txt, .xlsx) with --columns or, at a terminal, after questions
    about their columns; the answers are kept as FILE.columns.toml. Lists of an artefact's points, one file for each pose,
    need no questions (docs/reference/instrument-files.md). Facts that files do not state are asked for, or stay unknown and widen U.
    Temperatures given as options apply to files that state none. -m FILE: the machine with its chain and strokes, and its
    database. Without a terminal and without --yes the preview is printed, nothing is stored, and the exit code is 1.
    """
    check_inputs(*files)
    if len(files) == 1 and files[0].is_dir():
        _import_folder(files[0], db, machine, as_json=as_json)
        return

    from abbe.service.instrument_files.answers import Answers
    from abbe.service.instrument_files.point_list import is_point_list
    from abbe.service.instrument_files.registry import read_file

    if all(is_point_list(path) for path in files):
        _import_points(files, name or files[0].stem, (db, machine), as_json=as_json)
        return
    if len(files) == 1 and not files[0].suffix:  # it says what a campaign folder is
        _import_folder(files[0], db, machine, as_json=as_json)
        return
    answers = Answers(
        axis=axis, unit=unit, sign=sign, at_mm=at_mm, scale_c=scale_c, air_c=air_c, pressure_hpa=pressure_hpa, feed_mm_min=feed_mm_min
    )
    given = {
        "--name": name, "--columns": columns, "--axis": axis, "--unit": unit, "--sign": sign, "--at": at_mm, "--scale-temperature": scale_c,
        "--air-temperature": air_c, "--air-pressure": pressure_hpa, "--feed": feed_mm_min,
    }  # fmt: skip
    again = [part for option, value in given.items() if value is not None for part in (option, quote(str(value)))]
    command = " ".join(["abbe import", *(quote(str(path)) for path in files), *again, "--yes"])
    contents = [read_file(path, _columns(path, columns)) for path in files]
    _import_contents(contents, answers, name or files[0].stem, (db, machine), command, yes=yes, as_json=as_json)


def _import_points(files: list[Path], name: str, where: tuple[str | None, Path | None], *, as_json: bool) -> None:
    """Store lists of an artefact's points as one campaign, without questions."""
    from abbe.service.config import load_machine
    from abbe.service.instrument_files.point_list import campaign_of_points
    from abbe.service.runs.exchange import store_folder
    from abbe.service.site import site_of

    db, machine = where
    file = machine if db is not None else named_machine(machine)
    folder = campaign_of_points(files, name, None if file is None else site_of(load_machine(file).machine).doc)
    with open_store(database_url(db, machine), must_exist=False) as store:
        record = store.campaigns.find(store_folder(store, folder))
        _said(record.name, len(folder.runs), store.url, as_json=as_json)
    conclude(f"abbe solve {quote(record.name)}", machine=machine, db=db, as_json=as_json)


def _import_folder(folder: Path, db: str | None, machine: Path | None, *, as_json: bool) -> None:
    from abbe.service.runs.exchange import import_folder, read_folder

    _warn(read_folder(folder))  # before a database is created
    with open_store(database_url(db, machine), must_exist=False) as store:
        record = store.campaigns.find(import_folder(store, folder))
        _said(record.name, len(store.runs.all(record.id)), store.url, as_json=as_json)
    conclude(f"abbe solve {quote(record.name)}", machine=machine, db=db, as_json=as_json)


def _warn(folder: FolderContent) -> None:
    """Name readings that may be blunders on standard error; they are stored, too."""
    from abbe.service.verification.far_readings import far_angles, far_readings

    for line in (*far_readings(folder.runs), *far_angles(folder.campaign)):
        typer.echo(f"warning: {line}", err=True)


def _said(campaign: str, runs: int, url: str, *, beside: int = 0, as_json: bool) -> None:
    doc = {"campaign": campaign, "runs": runs, "beside": beside, "database": url}
    more = f" and {beside} tests and figures beside them" if beside else ""
    answer(doc, f"imported campaign {campaign!r} with {runs} runs{more} into {url}", as_json=as_json)


def _import_contents(
    contents: list[Content],
    answers: Answers,
    name: str,
    where: tuple[str | None, Path | None],
    command: str,
    *,
    yes: bool,
    as_json: bool,
) -> None:
    from abbe.service.config import load_machine
    from abbe.service.instrument_files.answers import checked
    from abbe.service.instrument_files.campaign import campaign_of
    from abbe.service.runs.exchange import store_folder
    from abbe.service.site import site_of

    db, machine = where
    file = machine if db is not None else named_machine(machine)
    site = None if file is None else site_of(load_machine(file).machine)
    answers = _asked(contents, checked(answers))
    made = campaign_of(contents, answers, name, None if site is None else site.doc)
    if not as_json:
        _preview(contents, answers, made)
    _warn(made.folder)
    if not yes and not (sys.stdin.isatty() and typer.confirm("Store this campaign?")):
        text = "nothing was stored" + ("" if sys.stdin.isatty() else ": --yes stores it")
        answer({"campaign": None, "runs": 0, "text": text}, text, as_json=as_json)
        conclude(command, machine=machine, db=db, as_json=as_json)
        raise typer.Exit(NOT_STORED)
    with open_store(database_url(db, machine), must_exist=False) as store:
        record = store.campaigns.find(store_folder(store, made.folder))
        beside = sum(len(made.folder.campaign.get(key, ())) for key in ("readings", "stated"))
        _said(record.name, len(made.folder.runs), store.url, beside=beside, as_json=as_json)
    conclude(f"abbe report {quote(record.name)}", machine=machine, db=db, as_json=as_json)


def _columns(path: Path, columns: Path | None) -> ColumnFile | None:
    """Return the column file of a table: the given one, the one beside the table, or one made by questions at the terminal; else None."""
    from abbe.service.instrument_files.columns import column_file, toml_of
    from abbe.service.instrument_files.registry import is_table

    if not is_table(path):
        return None
    kept = path.with_name(path.name + ".columns.toml")
    if columns is not None or kept.exists():
        return column_file(columns or kept)
    if not sys.stdin.isatty():
        return None
    found = _columns_asked(path)
    kept.write_text(toml_of(found), encoding="utf-8")
    typer.echo(f"your answers are in {kept}", err=True)
    return found


def _columns_asked(path: Path) -> ColumnFile:
    """Ask for heading, axis, columns and units of a table."""
    from abbe.service.instrument_files.answers import ANGLES, LENGTHS
    from abbe.service.instrument_files.columns import TIMES, ColumnFile, guesses, has_decimal_commas
    from abbe.service.instrument_files.registry import headings_of, likely_heading

    heading = typer.prompt(f"{path.name}: row of the headings (0: none)", type=int, default=likely_heading(path), err=True)
    names = headings_of(path, heading)
    guess = dict(guesses(names))

    def column(what: str, key: str, units: Sequence[str] = (), usual: str | None = None) -> dict[str, Any]:
        found = _choice(f"column of {what}", names, guess.get(key))
        unit = {"unit": _choice("its unit", units, usual)} if units else {}
        return {"column": found if heading else int(found)} | unit

    decimal = "."
    if has_decimal_commas(path.read_bytes()) and typer.confirm("are commas the decimal signs?", default=True, err=True):
        decimal = ","
    doc: dict[str, Any] = {"heading": heading, "decimal": decimal, "axis": _choice("which axis was measured", ("X", "Y", "Z"))}
    moves = typer.confirm("did this axis move from target to target (no: it stood still)?", default=True, err=True)
    if moves:
        doc["target"] = column("the targets", "target", list(LENGTHS), "mm")
    else:
        doc["at_mm"] = typer.prompt("where the axis stood, mm", type=float, err=True)
        doc["time"] = column("the time", "time", list(TIMES), "s")
    kind = _choice("readings are", ("deviation", "measured"), "measured" if "measured" in guess else "deviation")
    doc[kind] = column(f"the {kind} values", kind, list(LENGTHS | ANGLES) if kind == "deviation" else list(LENGTHS))
    if moves and typer.confirm("is there a column of the direction?", default="direction" in guess, err=True):
        words = {sign: _prompted(f"word for the {sign} direction of the axis", usual) for sign, usual in (("plus", "+"), ("minus", "-"))}
        doc["direction"] = column("the direction", "direction") | words
    return ColumnFile.model_validate(doc)


def _prompted(text: str, usual: str) -> str:
    return str(typer.prompt(text, default=usual, err=True))


def _asked(contents: Sequence[Content], answers: Answers) -> Answers:
    """Return the answers, completed at the terminal; without a terminal, unchanged."""
    from dataclasses import replace

    from abbe.service.instrument_files.answers import checked, open_questions

    if not sys.stdin.isatty():
        return answers
    for content in contents:
        while questions := open_questions(content, answers):
            answers = checked(replace(answers, **{questions[0].key: _answer(content.name, questions[0])}))
    return answers


def _answer(name: str, question: Question) -> Any:
    text = f"{name} does not say {question.text}"
    return _choice(text, question.choices) if question.choices else typer.prompt(text, type=float)


def _choice(text: str, choices: Sequence[str], usual: str | None = None) -> str:
    """Ask until one of the choices is given."""
    while (found := str(typer.prompt(f"{text} ({', '.join(choices)})", default=usual))) not in choices:
        typer.echo(f"{found!r} is not one of the choices")
    return found


def _preview(contents: Sequence[Content], answers: Answers, made: Made) -> None:
    from abbe.service.instrument_files.answers import settled
    from abbe.service.instrument_files.registry import preview_rows

    for content, origin in zip(contents, made.origins, strict=True):
        print_table(("what", "value"), preview_rows(content, settled(content, answers), origin))
