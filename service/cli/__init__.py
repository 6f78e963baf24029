"""The command ``abbe``. Nothing heavy is imported before a command runs: ``abbe --help`` answers at once."""

from __future__ import annotations

import codecs
import contextlib
import copy
import errno
import gc
import io
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typer import Typer

BAD_INPUT = 2
EXIT_CODES = {
    0: "done; the answer is yes",
    1: "done; the answer is no: out of limits, not kept, not proved, refused by a rule, an audit that was changed",
    2: "bad input or a fault: one line with a code says what, where, and what to do; nothing was lost",
    129: "the terminal was closed (SIGHUP)",
    130: "Ctrl-C (SIGINT)",
    143: "ended from outside (SIGTERM)",
}
"""Exit codes of every command; docs/reference/cli.md lists them."""
UNWRITTEN = frozenset((errno.EPIPE, errno.EBADF, errno.ENOSPC, errno.EFBIG, errno.EDQUOT))
"""``errno`` values of a failed write to stdout: reader gone, stdout closed, disk full, and so on."""
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit with its code (`EXIT_CODES`).

    ``arguments``: replace those of the command line, for tests.
    """
    # For matrices of a few hundred unknowns BLAS threads cost more than they save: minutes if other programs compute too.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")  # none is used, and to look for some reads the description of every package
    if arguments is None:
        gc.set_threshold(200_000)  # what imports make stays: searching it for garbage would be a sixth of a short command
        gc.callbacks.append(_begun)
    try:
        code = run(arguments)
    except KeyboardInterrupt:
        code = INTERRUPTED
    if arguments is None:
        gc.freeze()  # nor does the end of the interpreter search it
    sys.exit(code)


def _begun(_phase: str, _info: dict[str, int]) -> None:
    """Lower the threshold of the garbage collector at its first collection: by then imports are over and the command works."""
    gc.callbacks.remove(_begun)
    gc.set_threshold(50_000)  # as in `abbe.service.children`


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; every error of service, device or command line becomes one line on stderr.

    ``arguments``: replace those of the command line.
    """
    import typer

    from abbe.drivers.errors import DriverError
    from abbe.service.cli.app import app
    from abbe.service.errors import AbbeError

    if sys.stdout is None:
        sys.stdout = _Closed()
    _degrade()
    words = sys.argv[1:] if arguments is None else list(arguments)
    if words == ["--version"]:  # the usual option
        words = ["version"]
    try:
        code = int(named_by(app, words)(args=words, prog_name="abbe", standalone_mode=False) or 0)
        sys.stdout.flush()
        return code
    except (AbbeError, DriverError) as err:  # before OSError, to which a device's ReplyTimeout belongs too
        return complain(err.code, "; ".join([str(err), *getattr(err, "__notes__", [])]))
    except OSError as err:
        return _unwritten(err)
    except typer.Abort:
        return INTERRUPTED
    except typer.TyperException as err:
        text = err.format_message()
        if "\n" in text:  # no arguments at all: the message is the help
            sys.stderr.write(text.rstrip() + "\n")
            return BAD_INPUT
        if "unexpected extra argument" in text and ".toml" in text:  # the machine file once stood there
            return complain("USE-001", f"{text} - name the machine file by -m FILE")
        if err.__cause__ is not None:
            text = _value_told(text, err.__cause__)
        return complain("USE-001", f"{text} - `abbe --help` lists commands, `abbe COMMAND --help` their options")


def named_by(app: Typer, words: Sequence[str]) -> Typer:
    """Return the tree with only the command or group that the first word names; the whole tree if the word names none.

    Building the options of the other sixty commands would take a tenth of the time of a short command.
    """
    first = words[0] if words else ""
    own = [one for one in app.registered_commands if one.name == first]
    groups = [one for one in app.registered_groups if one.name == first]
    if not own and not groups:
        return app
    found = copy.copy(app)
    last = app.registered_commands[-1]  # of a single command typer would make no group
    found.registered_commands, found.registered_groups = [*own, last] if own != [last] else app.registered_commands[-2:], groups
    return found


def _value_told(text: str, cause: BaseException) -> str:
    """Return an error that states the expected and the given value instead of the library's message."""
    from pydantic import ValidationError

    from abbe.service.errors import mistakes

    if not isinstance(cause, ValidationError):
        return text
    first = mistakes(cause.errors())[0]
    return text.replace(first.message, first.expected)


class _Closed(io.TextIOBase):
    """Replaces a stdout that was closed before the program began (``>&-``): writing to it raises."""

    def write(self, text: str, /) -> int:
        """Raise OSError: stdout is closed."""
        raise OSError(errno.EBADF, "it is closed")


def _unwritten(err: OSError) -> int:
    """Return the exit code for output that cannot be written; re-raise any other OS error."""
    if err.filename is not None or err.errno not in UNWRITTEN:
        raise err
    with contextlib.suppress(OSError, ValueError):  # the rest of the buffer must not fail again at exit
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
    if err.errno == errno.EPIPE:
        return 1  # the reader has closed the pipe; typer does the same
    return complain("USE-002", f"the output cannot be written: {err.strerror} - redirect stdout to a file or pipe that can be written")


def complain(code: str, text: str) -> int:
    """Write one line of error to stderr: stable code, then what is wrong, where, what to do. Return the exit code for bad input."""
    from abbe.service.secrets import mask_secrets, visible

    if sys.stderr is not None:  # closed: only the exit code remains
        sys.stderr.write(f"error {code}: {visible(mask_secrets(' '.join(text.split())))}\n")
    return BAD_INPUT


PLAIN_ERRORS = "abbe-plain"
PLAIN = {
    "µ": "u",
    "μ": "u",
    "±": "+-",
    "×": "x",
    "·": "*",
    "°": "deg",
    "²": "^2",
    "³": "^3",
    "−": "-",
    "–": "-",
    "—": "-",
    "…": "...",
    "→": "->",
    "←": "<-",
    "↔": "<->",
    "≤": "<=",
    "≥": ">=",
    "≈": "~",
    "≠": "!=",
    "√": "sqrt",
    "∞": "inf",
    "σ": "sigma",
    "Δ": "delta",
    "’": "'",
    "‘": "'",
    "“": '"',
    "”": '"',
    "✔": "ok",
    "✖": "x",
}


def _degrade() -> None:
    """Make stdout and stderr write a plain substitute, or ``?``, for each character that their encoding lacks."""
    codecs.register_error(PLAIN_ERRORS, _plain)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=PLAIN_ERRORS)


def _plain(error: UnicodeError) -> tuple[str | bytes, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    out = []
    for one in error.object[error.start : error.end]:
        if 0xDC80 <= ord(one) <= 0xDCFF:  # a byte of a file name that is not text: show its escape
            out.append(f"\\x{ord(one) - 0xDC00:02x}")
            continue
        text = PLAIN.get(one, "?")
        try:
            text.encode(error.encoding)
        except UnicodeEncodeError:
            text = "?"
        out.append(text)
    return "".join(out), error.end
