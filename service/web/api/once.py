"""A request that changes something is done once for each Idempotency-Key: who repeats it gets the first answer again."""

from __future__ import annotations

import asyncio
import hashlib
import json
from collections.abc import Callable
from typing import Annotated

from fastapi import Header, Request
from fastapi.responses import Response
from pydantic import BaseModel

from abbe.service.errors import AbbeError, KeyInUse, KeyReused
from abbe.service.push.entries import canonical
from abbe.service.storage.store import Store
from abbe.service.web.login.auth_middleware import Visit
from abbe.service.web.problems import MEDIA_TYPE, problem_of

REPLAYED = "Idempotent-Replayed"
Key = Annotated[
    str,
    Header(
        alias="Idempotency-Key",
        pattern=r"^[A-Za-z0-9._:-]{1,100}$",
        description="Made up by the client for this request. Sent again with the same request, the first answer comes again; kept 7 days.",
    ),
]


async def once(store: Store, request: Request, key: str, body: BaseModel, work: Callable[[], BaseModel]) -> Response:
    """Do ``work`` in a thread, unless it was done for this key; answer what it gives.

    Raises
    ------
    KeyReused, KeyInUse
        The key came with another request before; its request is still being worked on.
    """
    visit: Visit = request.state.visit
    who = visit.principal.name
    digest = hashlib.sha256(canonical([request.method, request.url.path, body.model_dump(mode="json")])).hexdigest()
    known = await store.write(store.replies.claim, who, key, digest)
    if known is not None:
        answer = _again(known.digest == digest, known.status, known.body)
        visit.replayed = True  # for the audit: a decision stands in it once, and that somebody asked again as what it is
        return answer
    try:
        status, text = await asyncio.to_thread(_answer, work)
    except BaseException:
        await store.write(store.replies.drop, who, key)
        raise
    await store.write(store.replies.keep, who, key, status, text)
    return _response(status, text)


def _answer(work: Callable[[], BaseModel]) -> tuple[int, str]:
    """Status and body. A refusal is an answer as well; that the store is not there is none."""
    try:
        return 200, work().model_dump_json()
    except AbbeError as error:
        refused = problem_of(error)
        if refused.status_code >= 500:
            raise
        return refused.status_code, bytes(refused.body).decode()


def _again(same: bool, status: int | None, body: str | None) -> Response:
    if not same:
        raise KeyReused("this Idempotency-Key was sent with another request before", "a new request needs a new key")
    if status is None or body is None:
        raise KeyInUse("the request of this Idempotency-Key is still being worked on", "ask again after a minute")
    answer = _response(status, body)
    answer.headers[REPLAYED] = "true"
    return answer


def _response(status: int, text: str) -> Response:
    json.loads(text)  # what was kept is what is answered, and nothing but JSON
    return Response(text, status, media_type="application/json" if status < 400 else MEDIA_TYPE)
