"""The catalogue of error codes: those of the error classes, and those of HTTP statuses without a class.

``python -m abbe.service.web.catalogue`` prints the page docs/reference/error-codes.md; a test compares the two.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from dataclasses import dataclass

from abbe.drivers.errors import DriverError
from abbe.service import errors
from abbe.service.errors import AbbeError

DEFECT = "ABB-001"
HTTP: dict[int, tuple[str, str]] = {
    400: ("WEB-400", "The request is unreadable: no JSON, a missing or wrong header, or a foreign Host."),
    401: ("WEB-401", "No user is logged in, or the token is no longer valid."),
    403: ("WEB-403", "The user's role does not allow the request, or the request comes from a foreign page."),
    404: ("WEB-404", "There is no such path, or the number is impossible."),
    405: ("WEB-405", "The path has other methods; the header Allow lists them."),
    409: ("WEB-409", "The request contradicts the stored data."),
    413: ("WEB-413", "The request is too long for this path."),
    422: ("WEB-422", "A parameter or a field does not match the OpenAPI document; the detail names it."),
    429: ("WEB-429", "Too many requests from this address. Try again after the time in the header Retry-After."),
    500: (DEFECT, "A defect of this program. The service's log has the details."),
    503: ("WEB-503", "The service is overloaded or shutting down. Try again."),
}
"""Code and meaning of the statuses without an error class."""


@dataclass(frozen=True, slots=True)
class ErrorEntry:
    """An error code: name of its class, meaning, and HTTP status (None if the class has no status of its own)."""

    code: str
    name: str
    description: str
    status: int | None


STATUS: dict[type[AbbeError], int] = {
    errors.NotStored: 404,
    errors.JournalChanged: 409,
    errors.StoreError: 503,
    errors.AuditBroken: 503,
    errors.CoreUnavailable: 503,
    errors.KeyReused: 409,
    errors.KeyInUse: 409,
    errors.Unusable: 409,
    errors.AlarmRefused: 409,
    errors.TableRefused: 409,
    errors.FileFormatError: 409,
    errors.MeasurementFault: 409,
    errors.NotObservable: 409,
    errors.CampaignRefused: 409,
    errors.ModelUnknown: 409,
    errors.EffectUnknown: 409,
    errors.ConfigError: 409,
    errors.UserRefused: 409,
    errors.PasswordRefused: 409,
}
"""HTTP statuses of errors. A class that is missing here has the status of its nearest base class, else 500."""


def status_of(kind: type[AbbeError]) -> int:
    """HTTP status of an error class."""
    return next((STATUS[one] for one in kind.__mro__ if one in STATUS), 500)


def entries() -> list[ErrorEntry]:
    """The catalogue, in the order of the codes."""
    found = {code: ErrorEntry(code, f"HTTP {status}", description, status) for status, (code, description) in HTTP.items()}
    for kind in (*_tree(AbbeError), *_tree(DriverError)):
        status = status_of(kind) if issubclass(kind, AbbeError) else None
        found[kind.code] = ErrorEntry(kind.code, kind.__name__, _description(kind), None if status == 500 else status)
    return [found[code] for code in sorted(found)]


def page() -> str:
    """The catalogue as a Markdown page."""
    rows = [f"| {one.code} | {one.name} | {one.status or ''} | {one.description} |" for one in entries()]
    head = (
        "# Error codes\n\n"
        "Every error has a permanent code. The command line prints cause and remedy and ends with exit code 2; the HTTP\n"
        "interface answers `application/problem+json` (RFC 9457) with the code in `code`, and in `type` as `urn:abbe:error:CODE`.\n"
        "`python -m abbe.service.web.catalogue` makes this page from the error classes; `GET /api/v1/errors` returns the same.\n\n"
        "| code | name | HTTP | meaning |\n|---|---|---|---|\n"
    )
    return head + "\n".join(rows) + "\n"


def _tree(kind: type[AbbeError] | type[DriverError]) -> Iterator[type[AbbeError] | type[DriverError]]:
    """A class and its subclasses that belong to the product."""
    yield kind
    for below in kind.__subclasses__():
        if below.__module__ in {"abbe.service.errors", "abbe.drivers.errors"}:
            yield from _tree(below)


def _description(kind: type) -> str:
    """The first paragraph of a class's docstring, on one line."""
    text = inspect.getdoc(kind) or ""
    return " ".join(text.split("\n\n")[0].split()).replace("|", "\\|")


if __name__ == "__main__":
    sys.stdout.write(page())
