"""A revision that follows the newest one, as the next version of Abbe would bring it: it adds a table and a column."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from abbe.service.storage import engine, migrations

NEXT = "9000"
SOURCE = """
import sqlalchemy as sa
from alembic import op

revision = "9000"
down_revision = "{newest}"
branch_labels = None
depends_on = None


def upgrade():
    op.create_table("gauges", sa.Column("id", sa.Integer(), primary_key=True), sa.Column("name", sa.String(20), nullable=False))
    op.add_column("outbox", sa.Column("place", sa.String(20), nullable=True))


def downgrade():
    with op.batch_alter_table("outbox") as batch:
        batch.drop_column("place")
    op.drop_table("gauges")
"""


def install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """From now on this program is the next version; returns the revision that is the newest of today."""
    newest, name = engine.head_revision(), f"scripts_of_{folder.name.replace('-', '_')}"
    scripts = folder / name
    shutil.copytree(Path(migrations.__path__[0]), scripts, ignore=shutil.ignore_patterns("__pycache__"))
    (scripts / "versions" / f"r{NEXT}_gauges.py").write_text(SOURCE.format(newest=newest))
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setattr(engine, "_SCRIPTS", f"{name}:")
    monkeypatch.setattr(engine, "_VERSIONS", f"{name}.versions")
    monkeypatch.setattr(engine, "known_revisions", engine.known_revisions.__wrapped__)
    assert engine.head_revision() == NEXT
    sys.modules.pop(name, None)
    return newest
