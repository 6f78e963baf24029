"""The tables of what is decided over the network: rejections of proposals, and answers that are given once for each key."""

from __future__ import annotations

from sqlalchemy import Column, ForeignKey, Index, Integer, String, Table, Text, UniqueConstraint

from abbe.service.storage.tables import metadata

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
