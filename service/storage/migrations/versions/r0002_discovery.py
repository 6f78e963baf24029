"""Discoveries with their states, and the versions of machines' models."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "discoveries",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("doc", sa.JSON(), nullable=False),
        sa.Column("created_utc", sa.String(length=32), nullable=False),
        sa.ForeignKeyConstraint(["campaign_id"], ["campaigns.id"], name=op.f("fk_discoveries_campaign_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_discoveries")),
    )
    op.create_index(op.f("ix_discoveries_campaign_id"), "discoveries", ["campaign_id"], unique=False)
    op.create_table(
        "discovery_steps",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("discovery_id", sa.Integer(), nullable=False),
        sa.Column("seq", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=30), nullable=False),
        sa.Column("doc", sa.JSON(), nullable=False),
        sa.Column("utc", sa.String(length=32), nullable=False),
        sa.ForeignKeyConstraint(["discovery_id"], ["discoveries.id"], name=op.f("fk_discovery_steps_discovery_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_discovery_steps")),
        sa.UniqueConstraint("discovery_id", "seq", name=op.f("uq_discovery_steps_discovery_id")),
    )
    op.create_table(
        "machine_models",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("machine", sa.String(length=200), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("discovery_id", sa.Integer(), nullable=True),
        sa.Column("doc", sa.JSON(), nullable=False),
        sa.Column("created_utc", sa.String(length=32), nullable=False),
        sa.ForeignKeyConstraint(["discovery_id"], ["discoveries.id"], name=op.f("fk_machine_models_discovery_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_machine_models")),
        sa.UniqueConstraint("machine", "version", name=op.f("uq_machine_models_machine")),
    )


def downgrade() -> None:
    op.drop_table("machine_models")
    op.drop_table("discovery_steps")
    op.drop_index(op.f("ix_discoveries_campaign_id"), table_name="discoveries")
    op.drop_table("discoveries")
