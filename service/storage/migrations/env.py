"""Alembic's entry: runs on the connection that abbe.service.storage.engine hands over, inside its transaction."""

from __future__ import annotations

from alembic import context

from abbe.service.storage.tables import metadata

connection = context.config.attributes["connection"]
context.configure(connection=connection, target_metadata=metadata, render_as_batch=True, transactional_ddl=True, compare_type=True)
with context.begin_transaction():
    context.run_migrations()
