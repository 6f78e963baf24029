"""The command ``abbe``. Nothing heavy is imported before a command runs: ``abbe --help`` answers at once."""

from __future__ import annotations

import sys
from collections.abc import Sequence

BAD_INPUT = 2
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit with its code: 0 done, 1 the job's answer is no, 2 bad input or a fault, 130 Ctrl-C.

    Parameters
    ----------
    arguments : sequence of str, optional
        Instead of the command line's, for tests.
    """
    try:
        code = run(arguments)
    except KeyboardInterrupt:
        code = INTERRUPTED
    sys.exit(code)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command; every error of job, device or command line becomes one line on stderr.

    Parameters
    ----------
    arguments : sequence of str, optional
        Instead of the command line's.

    Returns
    -------
    int
        Exit code.
    """
    import typer

    from drivers.errors import DriverError
    from service.cli.app import app
    from service.errors import AbbeError

    try:
        return int(app(args=arguments, prog_name="abbe", standalone_mode=False) or 0)
    except (AbbeError, DriverError) as err:
        return complain(err.code, str(err))
    except typer.Abort:
        return INTERRUPTED
    except typer.TyperException as err:
        text = err.format_message()
        if "\n" in text:  # no arguments at all: the message is the help
            sys.stderr.write(text.rstrip() + "\n")
            return BAD_INPUT
        return complain("USE-001", f"{text} - `abbe --help` lists commands, `abbe COMMAND --help` their options")


def complain(code: str, text: str) -> int:
    """Write one line of error.

    Parameters
    ----------
    code : str
        Stable code.
    text : str
        What is wrong, where, what to do.

    Returns
    -------
    int
        Exit code for bad input.
    """
    from service.secrets import mask_secrets

    sys.stderr.write(f"error {code}: {mask_secrets(' '.join(text.split()))}\n")
    return BAD_INPUT
