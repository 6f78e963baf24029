"""The database's tables in SQLAlchemy Core. The migrations create exactly these (a test compares them)."""

from __future__ import annotations

from sqlalchemy import BigInteger, Column, Float, ForeignKey, Index, Integer, LargeBinary, MetaData, String, Table, Text, UniqueConstraint
from sqlalchemy.types import JSON

NAMING = {
    "pk": "pk_%(table_name)s",
    "fk": "fk_%(table_name)s_%(column_0_name)s",
    "uq": "uq_%(table_name)s_%(column_0_name)s",
    "ix": "ix_%(table_name)s_%(column_0_name)s",
}

metadata = MetaData(naming_convention=NAMING)

machines = Table(
    "machines",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("name", String(200), nullable=False),
    Column("doc", JSON, nullable=False),
    Column("doc_hash", String(64), nullable=False),
    Column("created_utc", String(32), nullable=False),
    UniqueConstraint("name", "doc_hash"),
)

campaigns = Table(
    "campaigns",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("machine_id", ForeignKey("machines.id"), nullable=False),
    Column("name", String(200), nullable=False, unique=True),
    Column("doc", JSON, nullable=False),
    Column("created_utc", String(32), nullable=False),
)

runs = Table(
    "runs",
    metadata,
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
    metadata,
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
    metadata,
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
    metadata,
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
    metadata,
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
    metadata,
    Column("id", Integer, primary_key=True),
    Column("campaign_id", ForeignKey("campaigns.id"), nullable=False),
    Column("digest", String(64), nullable=False),
    Column("doc", JSON, nullable=False),
    Column("created_utc", String(32), nullable=False),
    Index(None, "campaign_id"),
)

discovery_steps = Table(
    "discovery_steps",
    metadata,
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
    metadata,
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
    metadata,
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
    metadata,
    Column("id", Integer, primary_key=True),
    Column("uid", String(32), nullable=False),
)

push_entries = Table(
    "push_entries",
    metadata,
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
    metadata,
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
    metadata,
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
    metadata,
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
    metadata,
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
    metadata,
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
    metadata,
    Column("id", Integer, primary_key=True),
    Column("topic", String(500), nullable=False),
    Column("payload", LargeBinary, nullable=False),
    Column("created_utc", String(32), nullable=False),
    Column("sent_utc", String(32)),
    Index(None, "sent_utc"),
)

users = Table(
    "users",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("name", String(100), nullable=False, unique=True),
    Column("role", String(20), nullable=False),
    Column("password", String(200), nullable=False),
    Column("pin", String(200)),
    Column("pin_failures", Integer, nullable=False, server_default="0"),
    Column("disabled_utc", String(32)),
    Column("created_utc", String(32), nullable=False),
)

sessions = Table(
    "sessions",
    metadata,
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
    metadata,
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
    metadata,
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
    metadata,
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
    metadata,
    Column("id", Integer, primary_key=True),
    Column("who", String(200), nullable=False),
    Column("key", String(100), nullable=False),
    Column("digest", String(64), nullable=False),
    Column("status", Integer),
    Column("body", Text),
    Column("created_utc", String(32), nullable=False),
    UniqueConstraint("who", "key"),
)
