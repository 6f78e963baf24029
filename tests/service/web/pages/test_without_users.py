"""Whoever may only look learns how to get a right: without any user the command that adds one, otherwise the log-in."""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest

from abbe.service.web.language import NAMES, translate
from tests.pages_world import Filled, Served, as_user, served

HTML = {"Accept": "text/html"}


@pytest.fixture(scope="module")
def open_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("open")
    with served(Filled(f"sqlite:///{folder / 'abbe.sqlite3'}", "mill-7", [], {}, "", 0, [], 0), users=False) as one:
        yield one


@pytest.mark.parametrize("lang", NAMES)
def test_without_users_a_refusal_names_the_command_that_adds_one(open_page: Served, lang: str) -> None:
    answer = httpx.get(f"{open_page.base}/machine?lang={lang}", headers=HTML)
    assert answer.status_code == 403
    assert translate(lang, "rights.no_users") in answer.text
    assert "<code>abbe user add NAME admin -m machine.toml</code>" in answer.text
    assert 'class="go" href="/login"' not in answer.text


def test_a_user_without_the_right_finds_the_log_in(running: Served) -> None:
    with as_user(running, "vera", Accept="text/html") as client:
        answer = client.get("/machine")
        assert answer.status_code == 403
        assert '<a class="go" href="/login">' in answer.text
        assert "abbe user add" not in answer.text
