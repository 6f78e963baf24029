"""``abbe report``: a report for signature, as PDF, HTML, CSV or JSON, or as DCC, AQDEF or QIF for other programs."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import (
    DbOption,
    JsonOption,
    MachineOption,
    answer,
    check_endings,
    conclude,
    database_url,
    named_machine,
    open_store,
    run_or_campaign,
)

if TYPE_CHECKING:
    from datetime import date

    from abbe.service.domain.machine import Rules
    from abbe.service.rendering.document import Document


NUMBERED = ("push", "discovery", "verification")
OUT_HELP = "FILE.pdf, .html, .csv, .json, .xml (DCC), .dfq (AQDEF) or .qif; may be repeated. Default: a PDF here."


def report(  # noqa: PLR0913 - one argument for each option
    what: Annotated[
        str,
        typer.Argument(
            metavar="RUN|CAMPAIGN|FOLDER|push|discovery|verification",
            help="A run or campaign as for abbe show, a folder, or a kind with its number.",
        ),
    ],
    number: Annotated[
        int | None, typer.Argument(metavar="[N]", help="Number of the push, discovery or verification.", show_default=False)
    ] = None,
    out: Annotated[
        list[Path] | None,
        typer.Option("--out", metavar="FILE", help=OUT_HELP, show_default=False),
    ] = None,
    of: Annotated[
        str | None, typer.Option("--of", metavar="MACHINE", help="Machine of the push, if the database holds several.", show_default=False)
    ] = None,
    measured_on: Annotated[
        str | None,
        typer.Option("--measured-on", metavar="DATE", help="Day of the measurement, for a DCC of imported runs.", show_default=False),
    ] = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write a report: figures with U by ISO 230-2, -4, -6, conditions, certificates, decision, unobservable errors, signatures.

    The machine file gives database, limits, certificates, allowed temperature, and the expansion with which ISO 230-2 and 230-6 are
    reduced to 20 °C. Nothing is measured or computed again; the same data give the same bytes. A digital calibration certificate (.xml)
    needs [issuer] in the machine file and is not signed.
    """
    check_endings(*(out or []))
    # Both may be given: the machine file for its limits, and another database (an archive, a fleet's).
    url = database_url(db, machine if db is None else None)
    identifies = number is None and what not in NUMBERED and _identifies(what, url)

    from abbe.service.clock import SystemClock
    from abbe.service.config import load_machine
    from abbe.service.rendering.document_page import default_name, write_document
    from abbe.service.report.report import certified
    from abbe.service.site import rules_of
    from abbe.service.verification.reduction import AT_20, DIAGONAL_AT_20

    # A folder and another database may be of another machine: its file has to be named.
    file = machine if db is not None or Path(what).is_dir() else named_machine(machine)
    rules = rules_of(None if file is None else load_machine(file).machine)
    document = certified(_document(what, number, of, url, rules), rules, _day(measured_on), SystemClock().utc().date())
    targets = out or [Path(default_name(document))]
    for target in targets:
        write_document(document, target)
    _, word, text = document.verdict or ("", "", "")
    reduced = [f"{name}: {statement}." for name, statement in document.conditions.items() if name.startswith((AT_20, DIAGONAL_AT_20))]
    doc = {"files": [str(target) for target in targets], "title": document.title, "verdict": word, "text": text}
    lines = [*(f"report: {target}" for target in targets), f"{document.title}: {word}. {text}".strip(), *reduced]
    answer(doc, *lines, as_json=as_json)
    if identifies:
        conclude(f"abbe solve {quote(what)}", machine=machine, db=db, as_json=as_json)
    else:
        conclude("abbe trend", machine=machine, as_json=as_json)


def _identifies(what: str, url: str) -> bool:
    """Return whether a campaign, folder or run has runs to solve: a check has none."""
    from abbe.service.domain.measured import RunRecord

    if Path(what).is_dir():
        return True
    with open_store(url) as store:
        found = run_or_campaign(store, what)
        return not isinstance(found, RunRecord) and any(run.role == "identify" for run in store.runs.all(found.id))


def _day(text: str | None) -> date | None:
    from datetime import date

    from abbe.service.errors import ConfigError

    try:
        return None if text is None else date.fromisoformat(text)
    except ValueError:
        raise ConfigError(f"--measured-on is {text!r}, expected a day", "give it as 2026-11-26") from None


def _document(what: str, number: int | None, of: str | None, url: str, rules: Rules) -> Document:
    from abbe.service.errors import ConfigError
    from abbe.service.report.report import folder_report, numbered_report, stored_report

    if what in NUMBERED:
        if number is None:
            raise ConfigError(f"which {what}?", f"give its number: abbe report {what} N")
        with open_store(url) as store:
            return numbered_report(store, what, number, rules, of)
    if number is not None:
        raise ConfigError(f"{what} {number}: only {', '.join(NUMBERED)} have a number", "give one name: a run, a campaign or a folder")
    if Path(what).is_dir():
        return folder_report(Path(what), rules)
    with open_store(url) as store:
        return stored_report(store, run_or_campaign(store, what), rules)
