"""What several files share: a browser for all tests of a file, and ``abbe serve`` in this process, for starts that end in a refusal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from abbe.service import cli
from tests.system.test_serve_page import launched


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    """It keeps a loop in its thread: the tests of such a file are no coroutines."""
    with launched() as browser:
        yield browser


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., list[str]]:
    """What ``abbe serve`` says when it does not begin; the logs of the tests stay as they are."""
    monkeypatch.setattr("abbe.service.logs.configure_logs", lambda **_: None)

    def lines(file: Path, *words: str) -> list[str]:
        assert cli.run(["serve", "-m", str(file), *words]) == 2
        out, err = capsys.readouterr()
        assert err.splitlines()[-1].startswith("error ")
        return [*out.splitlines(), *err.splitlines()]

    return lines
