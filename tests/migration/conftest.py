"""Here migrations are what is tested: elsewhere a copy of what they make replaces Alembic's upgrade, in this folder it never does."""

from __future__ import annotations

import pytest
from alembic import command

UPGRADE = command.upgrade
"""Taken when tests are collected, before any of them runs."""


@pytest.fixture(autouse=True)
def _migrated_in_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("alembic.command.upgrade", UPGRADE)
