"""Functions that commands share: sorted help, ``--out``, the choice of machine and database, and output for people and for programs."""

from __future__ import annotations

import json
import os
import re
import shlex
import sys
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from abbe.service.domain.measured import CampaignRecord, RunRecord
    from abbe.service.queries.reader import Reader
    from abbe.service.storage.store import Store
import functools
import inspect
import io
from collections.abc import Iterator
from contextlib import redirect_stdout

from typer.core import TyperGroup

ENVIRONMENT, MACHINE_ENVIRONMENT = "ABBE_DB", "ABBE_MACHINE"
DEFAULT, DEFAULT_MACHINE = "sqlite:///abbe.sqlite3", "abbe.toml"

DbOption = Annotated[
    str | None,
    typer.Option(
        "--db",
        metavar="URL",
        help=f"Database, instead of the machine file's. Without a machine: {ENVIRONMENT}, else {DEFAULT}.",
        show_default=False,
    ),
]
MachineOption = Annotated[
    Path | None,
    typer.Option(
        "-m",
        "--machine",
        metavar="FILE",
        help=f"Machine file. Default: {MACHINE_ENVIRONMENT}, else {DEFAULT_MACHINE} in this folder.",
        show_default=False,
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON on stdout.")]
CampaignArgument = Annotated[str, typer.Argument(help="Campaign in the database, or a folder with campaign.json.")]
ReportOption = Annotated[
    Path | None,
    typer.Option("--report", metavar="FILE", help="Also write a report: FILE.pdf, .html, .csv or .json.", show_default=False),
]
WithoutOption = Annotated[list[str] | None, typer.Option("--without", metavar="RUN", help="Leave a run out; may be repeated.")]


def named_machine(given: Path | None) -> Path | None:
    """Return the machine file of a command: from ``-m``, else from ``ABBE_MACHINE``, else ``abbe.toml`` in this folder, else None."""
    if given is not None:
        return given
    if named := os.environ.get(MACHINE_ENVIRONMENT):
        return Path(named)
    return Path(DEFAULT_MACHINE) if Path(DEFAULT_MACHINE).is_file() else None


def machine_file(given: Path | None) -> Path:
    """Return the machine file of a command that needs one.

    Raises
    ------
    ConfigError
        No machine file is named (`named_machine`).
    """
    from abbe.service.errors import ConfigError

    if (found := named_machine(given)) is None:
        raise ConfigError("no machine is named", f"give -m FILE, set {MACHINE_ENVIRONMENT}, or go to the folder of {DEFAULT_MACHINE}")
    return found


def database_url(db: str | None, machine: Path | None = None) -> str:
    """Return the database of a command: ``--db``, else the database of the named machine file, else the environment's, else the default.

    Raises
    ------
    ConfigError
        Both options are given.
    """
    from abbe.service.errors import ConfigError

    if db is not None and machine is not None:
        raise ConfigError("--db and -m both name a database", "give one of them")
    if db is not None:
        return db
    if (found := named_machine(machine)) is not None:
        from abbe.service.config import load_machine

        return load_machine(found).database_url
    return os.environ.get(ENVIRONMENT) or DEFAULT


def open_store(url: str, *, must_exist: bool = True) -> Store:
    """Open the database of a command; the caller closes it.

    ``must_exist``: a missing SQLite file is an error, since a command that only reads must not leave an empty database behind.

    Raises
    ------
    StoreError
        The database cannot be opened.
    """
    from abbe.service.errors import StoreError
    from abbe.service.storage.store import Store

    if must_exist and (missing := missing_file(url)):
        raise StoreError(f"there is no database {missing}", "give -m FILE or --db URL")
    return Store.open(url)


def missing_file(url: str) -> str:
    """Return the path of a SQLite file that does not exist yet; empty if the file exists or the database is another kind."""
    from abbe.service.storage.engine import parse_url

    parsed = parse_url(url)
    named = parsed.database if parsed.drivername == "sqlite" else None
    return named if named and named != ":memory:" and not Path(named).exists() else ""


@contextmanager
def reader_of(machine: Path | None) -> Iterator[Reader]:
    """Yield the read model of a machine file: its database and its control. A missing database is an error and is not created."""
    from abbe.service.config import load_machine
    from abbe.service.domain.machine import control_of

    loaded = load_machine(machine_file(machine))
    with open_store(loaded.database_url) as store:
        yield reader(store, loaded.machine.name, control_of(loaded.machine.devices.cnc))


def reader(store: Store, machine: str = "", control: str = "") -> Reader:
    """Return the read model of an open database, with the current time."""
    from abbe.service.clock import SystemClock
    from abbe.service.queries.reader import Reader

    return Reader(store, machine, SystemClock(), control)


def warn_of_readers(url: str) -> None:
    """Warn on stderr if anyone but its owner may read a database file, which contains password hashes."""
    from abbe.service.storage.engine import database_readable_by_others

    if (warning := database_readable_by_others(url)) and sys.stderr is not None:
        sys.stderr.write(f"warning: {warning}\n")


def run_or_campaign(store: Store, name: str) -> RunRecord | CampaignRecord:
    """Return the campaign of this name, else the run; of a number the run. A run with the label of a campaign is CAMPAIGN/RUN.

    Raises
    ------
    StoreError
        Neither is in the database, or several runs have this label.
    """
    from abbe.service.errors import NotStored

    named = [one for one in store.campaigns.all() if one.name == name]
    if named and not name.isdecimal():
        return named[0]
    try:
        return store.runs.find(name)
    except NotStored:
        if not named:
            raise
        return named[0]


def check_endings(*targets: Path | None) -> None:
    """Refuse a report's file with an unknown ending, before the work; None: no file. Raises FileFormatError."""
    if given := list(filter(None, targets)):
        from abbe.service.rendering.document_page import form_of

        for target in given:
            form_of(target)


def check_inputs(*files: Path) -> None:
    """Refuse a file or folder that does not exist, before its reader is loaded. Raises FileFormatError."""
    from abbe.service.errors import FileFormatError

    for file in files:
        if not file.exists():
            raise FileFormatError(f"{file}: no such file", "give an existing file or folder")


def print_json(value: Any) -> None:
    """Write a value as JSON to stdout."""
    from abbe.service.secrets import visible_json

    sys.stdout.write(visible_json(json.dumps(value, indent=2, ensure_ascii=False)) + "\n")


NUMBER = re.compile(r"[-+−±≤≥~<>\d.,:;%/×x() \n]*")
"""Matches a cell that holds only numbers; such a cell is never broken."""
NARROWEST = 8
"""Least width of a column of words on a narrow terminal."""


def print_table(headings: Sequence[str], rows: Iterable[Sequence[str]], title: str | None = None) -> None:
    """Write a table to stdout: words fold at a terminal's width, numbers stay whole; into a pipe or file, tabs separate the cells."""
    from abbe.service.secrets import visible

    # Visible: names and targets come from outside.
    cells = [["\n".join(map(visible, cell.split("\n"))) for cell in row] for row in rows]
    if not sys.stdout.isatty():
        lines = ([title] if title else []) + ["\t".join(cell.replace("\n", "; ") for cell in row) for row in (headings, *cells)]
        sys.stdout.write("\n".join(lines) + "\n")
        return
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, box=SIMPLE_HEAD, title_justify="left", pad_edge=False)
    least = 0
    for heading, column in zip(headings, zip(*cells, strict=True) if cells else [()] * len(headings), strict=True):
        width = max((len(line) for cell in (heading, *column) for line in cell.split("\n")), default=0)
        number = all(map(NUMBER.fullmatch, column))
        width = width if number else min(NARROWEST, width)
        table.add_column(heading, no_wrap=number, overflow="fold", min_width=width)
        least += width + 3  # padding and divider
    for row in cells:
        table.add_row(*map(Text, row))  # Text: brackets in file names are not markup
    console = Console(highlight=False)
    console.width = max(console.width, least)
    console.print(table)


def answer(doc: Any, *lines: str, as_json: bool) -> None:
    """Write the answer of a command to stdout: ``doc`` as JSON for programs, or the lines for people."""
    if as_json:
        print_json(doc)
        return
    for line in lines:
        typer.echo(line)


def conclude(then: str, *, machine: Path | None = None, db: str | None = None, verdict: str = "", as_json: bool = False) -> None:
    """Print the verdict and the next command on stderr: stdout holds only the answer. With ``as_json``, print nothing.

    ``machine`` and ``db``, as they were given, are repeated in the next command.
    """
    from abbe.service.secrets import mask_secrets, visible

    if as_json or sys.stderr is None:
        return
    named = "" if machine is None else f" -m {shlex.quote(str(machine))}"
    named += "" if db is None else f" --db {shlex.quote(mask_secrets(db))}"
    sys.stdout.flush()
    with suppress(OSError):  # the terminal may be gone
        for line in filter(None, (verdict, f"next: {then}{named}")):
            sys.stderr.write(visible(line) + "\n")


MEASURE, UNDERSTAND, CORRECT, WATCH, MANAGE = "Measure", "Understand", "Correct", "Watch", "Manage"

OutOption = Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Write the answer to a file instead of stdout.")]


class GroupedHelp(TyperGroup):
    """A group that lists its commands under their headings, each with its whole first sentence."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the sections of the help; the order is that of the commands."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command: Any = self.get_command(ctx, name)
            heading = command.rich_help_panel
            sections.setdefault(heading if isinstance(heading, str) else "Commands", []).append((name, first_sentence(command.help or "")))
        for heading, rows in sections.items():
            with formatter.section(heading):
                formatter.write_dl(rows)


def first_sentence(text: str) -> str:
    """Return the first sentence of a help text, on one line."""
    return re.split(r"(?<=\.)\s+(?=[A-Z])", " ".join(text.split()), maxsplit=1)[0]


def give_form(app: typer.Typer) -> None:
    """Give every command of a tree its sorted help and the option ``--out``."""
    app.info.cls = GroupedHelp
    for group in app.registered_groups:
        group.cls = GroupedHelp
        if group.typer_instance is not None:
            give_form(group.typer_instance)
    for command in app.registered_commands:
        command.callback = _with_out(command.callback)


def _with_out(work: Any) -> Any:
    """Return a command with the option ``--out FILE``, unless it has its own. A command that fails leaves the file as it was."""
    code = inspect.unwrap(work).__code__
    own = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
    return work if "out" in own or "context" in own else _WithOut(work)


class _WithOut:
    """A command with ``--out FILE``. Its signature is computed on demand: for all sixty commands that would take a tenth of the time of
    ``--help``."""

    def __init__(self, work: Any) -> None:
        functools.update_wrapper(self, work)
        self._work = work

    def __call__(self, out: Path | None = None, **given: Any) -> Any:
        with answer_into(out):
            return self._work(**given)

    @property
    def __signature__(self) -> inspect.Signature:
        signature = inspect.signature(self._work, eval_str=True)
        added = inspect.Parameter("out", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=OutOption)
        return signature.replace(parameters=[*signature.parameters.values(), added])


@contextmanager
def answer_into(out: Path | None) -> Iterator[None]:
    """Collect the text written to stdout, and write it to the file ``out`` when the work has ended with an answer; None: do nothing."""
    if out is None:
        yield
        return
    from abbe.service.files import write_page

    text = io.StringIO()
    try:
        with redirect_stdout(text):
            yield
    except typer.Exit:  # an answer, too
        write_page(text.getvalue(), out)
        raise
    write_page(text.getvalue(), out)
