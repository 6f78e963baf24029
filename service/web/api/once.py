"""A request that changes something is executed once per Idempotency-Key; a repetition gets the first answer again."""

from __future__ import annotations

import asyncio
import hashlib
import json
from collections.abc import Callable
from typing import Annotated

from fastapi import Header, Request
from fastapi.responses import Response
from pydantic import BaseModel

from abbe.service.domain.document import canonical
from abbe.service.errors import AbbeError, KeyInUse, KeyReused
from abbe.service.storage.store import Store
from abbe.service.web.login.auth_middleware import Visit
from abbe.service.web.problems import MEDIA_TYPE, problem_of

REPLAYED = "Idempotent-Replayed"
Key = Annotated[
    str,
    Header(
        alias="Idempotency-Key",
        pattern=r"^[A-Za-z0-9._:-]{1,100}$",
        description="Chosen by the client for this request. Repeating key and request returns the first answer; kept for 7 days.",
    ),
]


async def once(store: Store, request: Request, key: str, body: BaseModel, work: Callable[[], BaseModel]) -> Response:
    """Do ``work`` in a thread, unless it was done for this key, and return its answer.

    Raises
    ------
    KeyReused
        The key belongs to another request.
    KeyInUse
        The first request with this key is still being processed.
    """
    visit: Visit = request.state.visit
    who = visit.principal.name
    digest = hashlib.sha256(canonical([request.method, request.url.path, body.model_dump(mode="json")])).hexdigest()
    known = await store.write(store.replies.claim, who, key, digest)
    if known is not None:
        answer = _replayed(known.digest == digest, known.status, known.body)
        visit.replayed = True  # the audit records the repetition as such, and the decision once
        return answer
    try:
        status, text = await asyncio.to_thread(_answer, work)
    except BaseException:
        await store.write(store.replies.drop, who, key)
        raise
    await store.write(store.replies.keep, who, key, status, text)
    return _response(status, text)


def _answer(work: Callable[[], BaseModel]) -> tuple[int, str]:
    """Do the work; return status and body of its answer. A refusal is an answer, too; an error with a status from 500 on is raised."""
    try:
        return 200, work().model_dump_json()
    except AbbeError as error:
        refused = problem_of(error)
        if refused.status_code >= 500:
            raise
        return refused.status_code, bytes(refused.body).decode()


def _replayed(same: bool, status: int | None, body: str | None) -> Response:
    if not same:
        raise KeyReused("this Idempotency-Key was sent with another request before", "a new request needs a new key")
    if status is None or body is None:
        raise KeyInUse("the request with this Idempotency-Key is still in progress", "try again after a minute")
    answer = _response(status, body)
    answer.headers[REPLAYED] = "true"
    return answer


def _response(status: int, text: str) -> Response:
    json.loads(text)  # stored answers must be JSON
    return Response(text, status, media_type="application/json" if status < 400 else MEDIA_TYPE)
