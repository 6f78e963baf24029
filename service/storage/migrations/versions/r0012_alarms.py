"""Alarms of machines, line by line: raised, held, acknowledged, cleared, what was investigated, proposed and pushed because of them."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "alarm_entries",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("machine", sa.String(length=200), nullable=False),
        sa.Column("alarm", sa.Integer(), nullable=False),
        sa.Column("seq", sa.Integer(), nullable=False),
        sa.Column("kind", sa.String(length=30), nullable=False),
        sa.Column("doc", sa.JSON(), nullable=False),
        sa.Column("utc", sa.String(length=32), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_alarm_entries")),
        sa.UniqueConstraint("machine", "alarm", "seq", name=op.f("uq_alarm_entries_machine")),
    )


def downgrade() -> None:
    op.drop_table("alarm_entries")
