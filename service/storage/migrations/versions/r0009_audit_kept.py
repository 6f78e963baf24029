"""The audit only grows: also against REPLACE, which deletes rows without a delete trigger, and against TRUNCATE."""

from __future__ import annotations

from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

NO_REPLACE = """
CREATE TRIGGER audit_no_replace BEFORE INSERT ON audit
WHEN NEW.id <> (SELECT COALESCE(MAX(id), 0) + 1 FROM audit) OR EXISTS (SELECT 1 FROM audit WHERE prev = NEW.prev)
BEGIN SELECT RAISE(ABORT, 'the audit only grows'); END
"""


def upgrade() -> None:
    if op.get_bind().dialect.name == "postgresql":
        op.execute("CREATE TRIGGER audit_not_emptied BEFORE TRUNCATE ON audit FOR EACH STATEMENT EXECUTE FUNCTION audit_only_grows()")
    else:
        op.execute(NO_REPLACE)


def downgrade() -> None:
    if op.get_bind().dialect.name == "postgresql":
        op.execute("DROP TRIGGER audit_not_emptied ON audit")
    else:
        op.execute("DROP TRIGGER audit_no_replace")
