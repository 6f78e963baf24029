"""The only mapping from errors to application/problem+json; codes and statuses come from the catalogue."""

from __future__ import annotations

from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from abbe.service.errors import AbbeError, mistakes
from abbe.service.web.catalogue import DEFECT, HTTP, status_of
from abbe.service.web.schemas import Problem

MEDIA_TYPE = "application/problem+json"
LONGEST = 1000
"""Largest length of a detail, in characters: a detail may repeat client input."""


def problem(status: int, detail: str, code: str = "", headers: dict[str, str] | None = None) -> JSONResponse:
    """An RFC 9457 response; the default code is that of the status."""
    code = code or HTTP.get(status, (f"WEB-{status}", ""))[0]
    # JSON can contain lone surrogates, which UTF-8 cannot.
    plain = detail[:LONGEST].encode("utf-8", "backslashreplace").decode("utf-8")
    body = Problem(type=f"urn:abbe:error:{code}", title=HTTPStatus(status).phrase, status=status, detail=plain, code=code)
    return JSONResponse(body.model_dump(), status, headers=headers, media_type=MEDIA_TYPE)


def problem_of(error: AbbeError) -> JSONResponse:
    """The response to an error of the service."""
    status = status_of(type(error))
    detail = error.detail + (f" - {error.remedy}" if error.remedy and status != 503 else "")
    return problem(status, detail, error.code, {"Retry-After": "5"} if status == 503 else None)


async def _http(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    return problem(error.status_code, str(error.detail), headers=dict(error.headers or {}))


async def _disconnected(_: Request, error: Exception) -> JSONResponse:
    # The client never reads this response; without a handler, the log would show a disconnect as a defect.
    assert isinstance(error, ClientDisconnect)
    return problem(400, "the request is incomplete")


async def _invalid(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    first = mistakes(error.errors())[0]
    # An impossible number is answered like an unknown number.
    return problem(404 if first.place[0] == "path" else 422, f"{first.path}: {first.message}")


async def _abbe(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, AbbeError)
    return problem_of(error)


async def _defect(request: Request, error: Exception) -> JSONResponse:
    if isinstance(error, MemoryError) and (end := getattr(request.app.state, "end", None)) is not None:
        end()  # a process at its memory limit does not recover: the core starts a new one
    # The traceback goes to the log (the server re-raises), not to the client.
    return problem(500, f"{type(error).__name__}: a defect of this program; see the service's log", DEFECT)


def install(app: FastAPI) -> None:
    """Answer every kind of error with a problem document."""
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(ClientDisconnect, _disconnected)
    app.add_exception_handler(AbbeError, _abbe)
    app.add_exception_handler(Exception, _defect)
