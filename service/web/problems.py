"""Errors as application/problem+json, mapped here and nowhere else."""

from __future__ import annotations

from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from service.errors import AbbeError, StoreError
from service.web.schemas import Problem

MEDIA_TYPE = "application/problem+json"


def problem(status: int, detail: str, code: str = "", headers: dict[str, str] | None = None) -> JSONResponse:
    """Return an RFC 9457 response."""
    body = Problem(title=HTTPStatus(status).phrase, status=status, detail=detail, code=code)
    return JSONResponse(body.model_dump(), status, headers=headers, media_type=MEDIA_TYPE)


async def _http(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    return problem(error.status_code, str(error.detail), headers=dict(error.headers or {}))


async def _invalid(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return problem(422, f"{where}: {first['msg']}")


async def _abbe(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, AbbeError)
    if isinstance(error, StoreError):
        return problem(503, error.detail, error.code, {"Retry-After": "5"})
    return problem(500, error.detail, error.code)


async def _defect(_: Request, error: Exception) -> JSONResponse:
    # The traceback goes to the log (the server re-raises); a client has no use for our insides.
    return problem(500, f"{type(error).__name__}: a defect of this program; see the service's log", "ABB-001")


def install(app: FastAPI) -> None:
    """Answer every kind of error with a problem document."""
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(AbbeError, _abbe)
    app.add_exception_handler(Exception, _defect)
