"""Form common to all commands: help in groups that is never cut, and ``--out FILE`` in place of standard output."""

from __future__ import annotations

import functools
import inspect
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

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
    """Give help, ``--out`` and their order to every command of a tree."""
    app.info.cls = GroupedHelp
    for group in app.registered_groups:
        group.cls = GroupedHelp
        if group.typer_instance is not None:
            give_form(group.typer_instance)
    for command in app.registered_commands:
        command.callback = _with_out(command.callback)


def _with_out(work: Any) -> Any:
    """Return a command with ``--out FILE``; one that has its own keeps it. A command that fails leaves a file as it was."""
    signature = inspect.signature(work, eval_str=True)
    if "out" in signature.parameters or "context" in signature.parameters:
        return work

    @functools.wraps(work)
    def around(out: Path | None = None, **given: Any) -> Any:
        with answer_into(out):
            return work(**given)

    added = inspect.Parameter("out", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=OutOption)
    around.__signature__ = signature.replace(parameters=[*signature.parameters.values(), added])  # type: ignore[attr-defined]
    return around


@contextmanager
def answer_into(out: Path | None) -> Iterator[None]:
    """Collect what is written to stdout, and write it to a file when the work has ended with an answer; None: leave it alone."""
    if out is None:
        yield
        return
    from abbe.service.rendering.page_file import write_page

    text = io.StringIO()
    try:
        with redirect_stdout(text):
            yield
    except typer.Exit:  # an answer, too
        write_page(text.getvalue(), out)
        raise
    write_page(text.getvalue(), out)
