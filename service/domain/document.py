"""A document: what is stored or sent as JSON."""

from __future__ import annotations

from typing import Any

Doc = dict[str, Any]
"""A JSON object."""
