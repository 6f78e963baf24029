"""The first schema. It defines its own tables, because those of the program have changed since (decision 0033)."""

from __future__ import annotations

import uuid

from alembic import op
from sqlalchemy import BigInteger, Column, Float, ForeignKey, Index, Integer, LargeBinary, MetaData, String, Table, Text, UniqueConstraint
from sqlalchemy.types import JSON

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
"""The third trigger is for REPLACE, which deletes rows without a delete trigger."""

NAMING = {
    "pk": "pk_%(table_name)s",
    "fk": "fk_%(table_name)s_%(column_0_name)s",
    "uq": "uq_%(table_name)s_%(column_0_name)s",
    "ix": "ix_%(table_name)s_%(column_0_name)s",
}

first = MetaData(naming_convention=NAMING)

machines = Table(
    "machines",
    first,
    Column("id", Integer, primary_key=True),
    Column("name", String(200), nullable=False),
    Column("doc", JSON, nullable=False),
    Column("doc_hash", String(64), nullable=False),
    Column("created_utc", String(32), nullable=False),
    UniqueConstraint("name", "doc_hash"),
)

campaigns = Table(
    "campaigns",
    first,
    Column("id", Integer, primary_key=True),
    Column("machine_id", ForeignKey("machines.id"), nullable=False),
    Column("name", String(200), nullable=False, unique=True),
    Column("doc", JSON, nullable=False),
    Column("created_utc", String(32), nullable=False),
)

runs = Table(
    "runs",
    first,
    Column("id", Integer, primary_key=True),
    Column("campaign_id", ForeignKey("campaigns.id"), nullable=False),
    Column("label", String(100), nullable=False),
    Column("test", String(40), nullable=False),
    Column("role", String(20), nullable=False),
    Column("status", String(20), nullable=False),
    Column("reason", Text, nullable=False),
    Column("start_doc", JSON, nullable=False),
    Column("end_doc", JSON(none_as_null=True)),
    Column("started_utc", String(32), nullable=False),
    Column("ended_utc", String(32)),
    Column("owner_host", String(255), nullable=False),
    Column("owner_pid", Integer, nullable=False),
    Column("owner_start", String(80), nullable=False),
    UniqueConstraint("campaign_id", "label"),
)

chunks = Table(
    "chunks",
    first,
    Column("id", Integer, primary_key=True),
    Column("run_id", ForeignKey("runs.id"), nullable=False),
    Column("channel", String(40), nullable=False),
    Column("seq", Integer, nullable=False),
    Column("n", Integer, nullable=False),
    Column("codec", String(20), nullable=False),
    Column("crc32", BigInteger, nullable=False),
    Column("payload", LargeBinary, nullable=False),
    Column("first_host_s", Float, nullable=False),
    Column("last_host_s", Float, nullable=False),
    Column("first_device_us", BigInteger, nullable=False),
    Column("last_device_us", BigInteger, nullable=False),
    UniqueConstraint("run_id", "channel", "seq"),
)

solutions = Table(
    "solutions",
    first,
    Column("id", Integer, primary_key=True),
    Column("campaign_id", ForeignKey("campaigns.id"), nullable=False),
    Column("kind", String(40), nullable=False),
    Column("run_ids", JSON, nullable=False),
    Column("doc", JSON, nullable=False),
    Column("created_utc", String(32), nullable=False),
    Index(None, "campaign_id"),
)

comp_tables = Table(
    "tables",
    first,
    Column("id", Integer, primary_key=True),
    Column("machine_id", ForeignKey("machines.id"), nullable=False),
    Column("solution_id", ForeignKey("solutions.id")),
    Column("image", LargeBinary, nullable=False),
    Column("crc", BigInteger, nullable=False),
    Column("doc", JSON, nullable=False),
    Column("created_utc", String(32), nullable=False),
    Index(None, "machine_id"),
)

verifications = Table(
    "verifications",
    first,
    Column("id", Integer, primary_key=True),
    Column("machine_id", ForeignKey("machines.id"), nullable=False),
    Column("campaign_id", ForeignKey("campaigns.id")),
    Column("verdict", String(30), nullable=False),
    Column("doc", JSON, nullable=False),
    Column("utc", String(32), nullable=False),
    Index(None, "machine_id"),
)

discoveries = Table(
    "discoveries",
    first,
    Column("id", Integer, primary_key=True),
    Column("campaign_id", ForeignKey("campaigns.id"), nullable=False),
    Column("digest", String(64), nullable=False),
    Column("doc", JSON, nullable=False),
    Column("created_utc", String(32), nullable=False),
    Index(None, "campaign_id"),
)

discovery_steps = Table(
    "discovery_steps",
    first,
    Column("id", Integer, primary_key=True),
    Column("discovery_id", ForeignKey("discoveries.id"), nullable=False),
    Column("seq", Integer, nullable=False),
    Column("state", String(30), nullable=False),
    Column("doc", JSON, nullable=False),
    Column("utc", String(32), nullable=False),
    UniqueConstraint("discovery_id", "seq"),
)

machine_models = Table(
    "machine_models",
    first,
    Column("id", Integer, primary_key=True),
    Column("machine", String(200), nullable=False),
    Column("version", Integer, nullable=False),
    Column("discovery_id", ForeignKey("discoveries.id")),
    Column("doc", JSON, nullable=False),
    Column("created_utc", String(32), nullable=False),
    UniqueConstraint("machine", "version"),
)

checkpoints = Table(
    "checkpoints",
    first,
    Column("id", Integer, primary_key=True),
    Column("campaign_id", ForeignKey("campaigns.id"), nullable=False),
    Column("seq", Integer, nullable=False),
    Column("kind", String(30), nullable=False),
    Column("doc", JSON, nullable=False),
    Column("utc", String(32), nullable=False),
    UniqueConstraint("campaign_id", "seq"),
)

identity = Table(
    "identity",
    first,
    Column("id", Integer, primary_key=True),
    Column("uid", String(32), nullable=False),
)

push_entries = Table(
    "push_entries",
    first,
    Column("id", Integer, primary_key=True),
    Column("machine", String(200), nullable=False),
    Column("push", Integer, nullable=False),
    Column("seq", Integer, nullable=False),
    Column("state", String(30), nullable=False),
    Column("doc", JSON, nullable=False),
    Column("utc", String(32), nullable=False),
    Column("prev", String(64), nullable=False),
    Column("digest", String(64), nullable=False),
    UniqueConstraint("machine", "prev"),
)

proposals = Table(
    "proposals",
    first,
    Column("id", Integer, primary_key=True),
    Column("machine", String(200), nullable=False),
    Column("solution_id", ForeignKey("solutions.id"), nullable=False),
    Column("doc", JSON, nullable=False),
    Column("digest", String(64), nullable=False),
    Column("created_utc", String(32), nullable=False),
    Index(None, "machine"),
)

approvals = Table(
    "approvals",
    first,
    Column("id", Integer, primary_key=True),
    Column("proposal_id", ForeignKey("proposals.id"), nullable=False),
    Column("name", String(200), nullable=False),
    Column("login", String(200), nullable=False),
    Column("digest", String(64), nullable=False),
    Column("expiry", String(40), nullable=False),
    Column("utc", String(32), nullable=False),
    Index(None, "proposal_id"),
)

alarm_entries = Table(
    "alarm_entries",
    first,
    Column("id", Integer, primary_key=True),
    Column("machine", String(200), nullable=False),
    Column("alarm", Integer, nullable=False),
    Column("seq", Integer, nullable=False),
    Column("kind", String(30), nullable=False),
    Column("doc", JSON, nullable=False),
    Column("utc", String(32), nullable=False),
    UniqueConstraint("machine", "alarm", "seq"),
)

slots = Table(
    "slots",
    first,
    Column("id", Integer, primary_key=True),
    Column("schedule", String(200), nullable=False),
    Column("slot_utc", String(32), nullable=False),
    Column("state", String(30), nullable=False),
    Column("claimed_utc", String(32), nullable=False),
    Column("finished_utc", String(32)),
    Column("reason", Text),
    Column("owner_host", String(255)),
    Column("owner_pid", Integer),
    Column("owner_start", String(80)),
    UniqueConstraint("schedule", "slot_utc"),
)

heartbeats = Table(
    "stations",
    first,
    Column("id", Integer, primary_key=True),
    Column("machine", String(200), nullable=False),
    Column("doc", JSON, nullable=False),
    Column("seen_utc", String(32), nullable=False),
    Column("owner_host", String(255), nullable=False),
    Column("owner_pid", Integer, nullable=False),
    Column("owner_start", String(80), nullable=False),
    UniqueConstraint("machine"),
)

outbox = Table(
    "outbox",
    first,
    Column("id", Integer, primary_key=True),
    Column("topic", String(500), nullable=False),
    Column("payload", LargeBinary, nullable=False),
    Column("created_utc", String(32), nullable=False),
    Column("sent_utc", String(32)),
    Index(None, "sent_utc"),
)

users = Table(
    "users",
    first,
    Column("id", Integer, primary_key=True),
    Column("name", String(100), nullable=False, unique=True),
    Column("role", String(20), nullable=False),
    Column("password", String(200), nullable=False),
    Column("disabled_utc", String(32)),
    Column("created_utc", String(32), nullable=False),
)

sessions = Table(
    "sessions",
    first,
    Column("id", Integer, primary_key=True),
    Column("user_id", ForeignKey("users.id"), nullable=False),
    Column("digest", String(64), nullable=False, unique=True),
    Column("created_utc", String(32), nullable=False),
    Column("seen_utc", String(32), nullable=False),
    Column("ended_utc", String(32)),
    Index(None, "user_id"),
)

api_tokens = Table(
    "api_tokens",
    first,
    Column("id", Integer, primary_key=True),
    Column("user_id", ForeignKey("users.id"), nullable=False),
    Column("name", String(100), nullable=False),
    Column("prefix", String(16), nullable=False, unique=True),
    Column("digest", String(64), nullable=False),
    Column("scopes", JSON, nullable=False),
    Column("created_utc", String(32), nullable=False),
    Column("expires_utc", String(32), nullable=False),
    Column("revoked_utc", String(32)),
    UniqueConstraint("user_id", "name"),
)

audit = Table(
    "audit",
    first,
    Column("id", Integer, primary_key=True),
    Column("utc", String(32), nullable=False),
    Column("who", String(200), nullable=False),
    Column("action", String(200), nullable=False),
    Column("target", Text, nullable=False),
    Column("outcome", String(200), nullable=False),
    Column("doc", JSON, nullable=False),
    Column("prev", String(64), nullable=False),
    Column("digest", String(64), nullable=False),
    Column("key", String(16), nullable=False),
    Column("mac", String(64), nullable=False),
    UniqueConstraint("prev"),
)

rejections = Table(
    "rejections",
    first,
    Column("id", Integer, primary_key=True),
    Column("proposal_id", ForeignKey("proposals.id"), nullable=False),
    Column("name", String(200), nullable=False),
    Column("login", String(200), nullable=False),
    Column("reason", Text, nullable=False),
    Column("utc", String(32), nullable=False),
    Index(None, "proposal_id"),
)

replies = Table(
    "replies",
    first,
    Column("id", Integer, primary_key=True),
    Column("who", String(200), nullable=False),
    Column("key", String(100), nullable=False),
    Column("digest", String(64), nullable=False),
    Column("status", Integer),
    Column("body", Text),
    Column("created_utc", String(32), nullable=False),
    UniqueConstraint("who", "key"),
)


def upgrade() -> None:
    connection = op.get_bind()
    first.create_all(connection, checkfirst=False)
    for statement in ONLY_GROWS_POSTGRESQL if connection.dialect.name == "postgresql" else ONLY_GROWS_SQLITE:
        op.execute(statement)
    op.bulk_insert(identity, [{"id": 1, "uid": uuid.uuid4().hex}])


def downgrade() -> None:
    connection = op.get_bind()
    first.drop_all(connection, checkfirst=False)
    if connection.dialect.name == "postgresql":
        op.execute("DROP FUNCTION audit_only_grows()")
