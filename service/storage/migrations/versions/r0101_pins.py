"""Users get a PIN and the count of wrong ones. Databases of revision 0100 from 27 November 2026 on may have the column ``pin`` already."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0101"
down_revision = "0100"
branch_labels = None
depends_on = None


def upgrade() -> None:
    known = {column["name"] for column in sa.inspect(op.get_bind()).get_columns("users")}
    if "pin" not in known:
        op.add_column("users", sa.Column("pin", sa.String(200)))
    op.add_column("users", sa.Column("pin_failures", sa.Integer, nullable=False, server_default="0"))


def downgrade() -> None:
    op.drop_column("users", "pin_failures")
    op.drop_column("users", "pin")
