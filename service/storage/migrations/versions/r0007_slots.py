"""Why a slot ended as it did, and which process has it: a slot whose process is gone is nobody's, and is decided anew."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

NEW = (("reason", sa.Text()), ("owner_host", sa.String(length=255)), ("owner_pid", sa.Integer()), ("owner_start", sa.String(length=80)))


def upgrade() -> None:
    for name, kind in NEW:
        op.add_column("slots", sa.Column(name, kind, nullable=True))


def downgrade() -> None:
    with op.batch_alter_table("slots") as batch:
        for name, _ in reversed(NEW):
            batch.drop_column(name)
