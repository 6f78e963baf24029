"""The first schema: until the first release, the tables that the program has at present.

Databases from before the first release are not migrated (decision 0033). Once there is a second revision, this one has to state its own
tables; a test checks this.
"""

from __future__ import annotations

import uuid

from alembic import op

from abbe.service.storage.tables import identity, metadata

revision = "0100"
down_revision = None
branch_labels = None
depends_on = None

ONLY_GROWS_POSTGRESQL = (
    """
    CREATE FUNCTION audit_only_grows() RETURNS trigger AS $$
    BEGIN RAISE EXCEPTION 'the audit only grows'; END $$ LANGUAGE plpgsql
    """,
    "CREATE TRIGGER audit_kept BEFORE UPDATE OR DELETE ON audit FOR EACH ROW EXECUTE FUNCTION audit_only_grows()",
    "CREATE TRIGGER audit_not_emptied BEFORE TRUNCATE ON audit FOR EACH STATEMENT EXECUTE FUNCTION audit_only_grows()",
)
ONLY_GROWS_SQLITE = (
    "CREATE TRIGGER audit_no_update BEFORE UPDATE ON audit BEGIN SELECT RAISE(ABORT, 'the audit only grows'); END",
    "CREATE TRIGGER audit_no_delete BEFORE DELETE ON audit BEGIN SELECT RAISE(ABORT, 'the audit only grows'); END",
    """
    CREATE TRIGGER audit_no_replace BEFORE INSERT ON audit
    WHEN NEW.id <> (SELECT COALESCE(MAX(id), 0) + 1 FROM audit) OR EXISTS (SELECT 1 FROM audit WHERE prev = NEW.prev)
    BEGIN SELECT RAISE(ABORT, 'the audit only grows'); END
    """,
)
"""REPLACE deletes rows without a delete trigger."""


def upgrade() -> None:
    connection = op.get_bind()
    metadata.create_all(connection, checkfirst=False)
    for statement in ONLY_GROWS_POSTGRESQL if connection.dialect.name == "postgresql" else ONLY_GROWS_SQLITE:
        op.execute(statement)
    op.bulk_insert(identity, [{"id": 1, "uid": uuid.uuid4().hex}])


def downgrade() -> None:
    connection = op.get_bind()
    metadata.drop_all(connection, checkfirst=False)
    if connection.dialect.name == "postgresql":
        op.execute("DROP FUNCTION audit_only_grows()")
