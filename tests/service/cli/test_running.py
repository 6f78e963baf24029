"""The question at the console, on a real terminal: only an answer given after the question counts."""

import asyncio
import contextlib
import io
import os
import select
import sys

import pytest

from abbe.service.cli.running import console_ask
from abbe.service.errors import ConfigError
from tests.patience import within


@pytest.fixture
def terminal(monkeypatch):
    """A pseudo terminal as standard input; gives its other end, where the person types."""
    person, console = os.openpty()
    with os.fdopen(console, closefd=True) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield person
    os.close(person)


async def asked(text: str = "hang in the bar") -> asyncio.Task[None]:
    """A question that stands on the screen and has had every chance to take what was typed before."""
    with contextlib.redirect_stderr(io.StringIO()) as screen:
        task = asyncio.create_task(console_ask(text))
        for _ in range(20):  # each turn of the loop looks at the terminal once
            await asyncio.sleep(0)
    assert text in screen.getvalue()
    return task


def typed(person: int, text: bytes) -> None:
    """Type, and wait until it has arrived at the other end."""
    os.write(person, text)
    if b"\n" in text:
        assert select.select([sys.stdin], [], [], 5.0)[0]


@pytest.mark.parametrize("early", [b"\n", b"\n\n\n", b"yes"])
async def test_what_was_typed_before_the_question_confirms_nothing(terminal, early):
    typed(terminal, early)
    task = await asked()
    assert not task.done()
    os.write(terminal, b"\n")
    async with asyncio.timeout(within(5)):
        await task


async def test_one_answer_does_not_answer_the_next_question(terminal):
    task = await asked("first")
    os.write(terminal, b"\n\n")
    async with asyncio.timeout(within(5)):
        await task
    task = await asked("second")
    assert not task.done()
    os.write(terminal, b"\n")
    async with asyncio.timeout(within(5)):
        await task


async def test_end_of_input_is_no_confirmation(terminal):
    task = await asked()
    os.write(terminal, b"\x04")  # Ctrl-D
    async with asyncio.timeout(within(5)):
        with pytest.raises(ConfigError, match="standard input was closed"):
            await task


async def test_without_a_terminal_the_request_is_named(monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n"))
    with pytest.raises(ConfigError, match="no one is at the console, but a person has to act: hang in the bar"):
        await console_ask("hang in the bar")
