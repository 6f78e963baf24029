"""The audit in words for people: who did what to which object, with which outcome. The record itself is shown below, unchanged."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath
from types import MappingProxyType

from fastapi import FastAPI
from fastapi.responses import HTMLResponse

from abbe.service.domain.people import Permission, Role
from abbe.service.domain.service_records import AuditEntry
from abbe.service.rendering.phrases import phrase
from abbe.service.web.frame import current
from abbe.service.web.language import catalogue
from abbe.service.web.login.access import needs
from abbe.service.web.pages.context import PageContext
from abbe.service.web.pages.file_fields import with_names

ROWS = 200
FILE = "machine file"
DEEDS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "log_in": ("POST /login",),
        "log_out": ("POST /logout",),
        "approve": ("POST /proposal/approve", "POST /api/v1/proposals/{number}/approve", "abbe comp approve"),
        "reject": ("POST /proposal/reject", "POST /api/v1/proposals/{number}/reject", "abbe comp reject"),
        "push": ("POST /api/v1/proposals/{number}/push", "push", "abbe comp push"),
        "rollback": ("POST /api/v1/tables/rollback", "rollback", "abbe comp rollback"),
        "acknowledge": ("POST /alarm/acknowledge", "abbe alarm acknowledge"),
        "shelve": ("POST /alarm/shelve",),
        "user_add": ("POST /users/add", "abbe user add"),
        "user_role": ("POST /users/role", "abbe user role"),
        "user_password": ("POST /users/password", "abbe user password"),
        "user_disable": ("POST /users/disable", "abbe user disable"),
        "user_enable": ("POST /users/enable", "abbe user enable"),
        "file_laboratory": ("POST /administration/laboratory",),
        "file_limits": ("POST /administration/limits",),
        "file_certificates": ("POST /administration/certificates",),
        "file_schedule": ("POST /administration/schedule",),
        "file_read": ("POST /administration/read",),
        "file": (FILE,),
        "own_password": ("POST /settings/password",),
        "own_pin": ("POST /settings/pin",),
        "token_new": ("abbe user token new",),
        "token_revoke": ("abbe user token revoke",),
        "start": ("POST /api/v1/jobs",),
        "measure": ("campaign", "abbe measure", "abbe listen"),
        "by_hand": ("POST /api/v1/jobs/{job}/prompts/{prompt}/done",),
        "stop": ("POST /api/v1/stop", "POST /api/v1/jobs/{job}/stop"),
        "abort": ("POST /api/v1/jobs/{job}/abort",),
        "pause": ("POST /api/v1/jobs/{job}/pause",),
        "resume": ("POST /api/v1/jobs/{job}/resume",),
        "support": ("support bundle",),
        "serve": ("abbe serve",),
        "solve": ("abbe solve", "abbe solve-all"),
        "discover": ("abbe discover",),
        "correct": ("abbe correct",),
        "accept": ("abbe accept-table",),
        "import": ("abbe import",),
        "model": ("abbe model revert",),
        "propose": ("abbe comp propose",),
        "commission": ("abbe comp commission",),
        "files": ("abbe comp drop", "abbe comp import"),
        "sign": ("abbe comp export",),
        "key": ("abbe key new",),
        "backup": ("abbe backup",),
        "restore": ("abbe restore",),
        "demo": ("abbe demo",),
    }
)
"""The recorded actions of each deed; the catalogues translate a deed under the key ``deed.NAME``."""
_OF = {action: deed for deed, actions in DEEDS.items() for action in actions}
_ENDS = {"done": "ok", "kept": "ok", "refused": "bad", "failed": "bad", "rolled back": "bad"}
_JOB = re.compile(r"^job [0-9a-f]+(, )?")
_FAULT = re.compile(r"[A-Z]{3}-\d+")
_ACCOUNT = re.compile(r"os:(?P<name>[^@]*)@(?P<host>.*)|token:(?P<owner>[^/]*)/(?P<token>.*)|user:(?P<user>.*)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Deed:
    """One record in the reader's language. ``sign``: sign of its outcome, as in `abbe.service.web.pages.proposals.sign`."""

    record: AuditEntry
    who: str
    what: str
    target: str
    end: str
    sign: str


def deed(record: AuditEntry) -> Deed:
    """A record in the reader's language; actions without a translation are shown as recorded."""
    known = _OF.get(record.action)
    what = record.action if known is None else current().translate(f"deed.{known}")
    end, sign = _end(record.outcome)
    return Deed(record, _who(record.who), what, _target(record), end, sign)


def _who(who: str) -> str:
    frame, found = current(), _ACCOUNT.fullmatch(who)
    if found is None:
        return frame.state("audit.who", who)
    if found["host"] is not None:
        return frame.translate("audit.at_computer", name=found["name"], host=found["host"])
    return found["user"] or frame.translate("audit.by_token", name=found["owner"], token=found["token"])


def _target(record: AuditEntry) -> str:
    """The target without numbers of jobs and addresses, which only programs need; a file of a command appears by its name alone."""
    frame, text = current(), _JOB.sub("", record.target)
    if text.startswith("/") and record.action.startswith("abbe "):
        return PurePath(text).name
    if text.startswith(("/", "job ")):
        return ""
    if record.action == FILE:
        return with_names(text)
    if text.startswith("user "):
        name, _, change = text.removeprefix("user ").partition(": ")
        role = change.rpartition(" ")[2]
        return f"{name}: {frame.state('user', role)}" if role in set(Role) else name if len(change.split()) <= 1 else text
    return ", ".join(phrase(frame.lang, part) for part in text.split(", "))


def _end(outcome: str) -> tuple[str, str]:
    """Words and sign of an outcome such as ``done 303``, ``kept`` or ``TBL-001``."""
    frame, word = current(), re.sub(r"( \d+|: .*)$", "", outcome)
    if _FAULT.fullmatch(word):
        return frame.translate("audit.end.fault", code=word), "bad"
    group = "audit.end" if f"audit.end.{word}" in catalogue(frame.lang) else "alarm.kind"  # the service records what it does for an alarm
    return frame.state(group, word), _ENDS.get(word, "open")


def add_audit(app: FastAPI, context: PageContext) -> None:
    """Add the screen of the audit to the application."""

    @app.get("/audit", include_in_schema=False)
    @needs(Permission.AUDIT)
    async def audit() -> HTMLResponse:
        records = await context.read(context.store.audit.events, ROWS)
        return await context.show("audit.html", deeds=[deed(one) for one in reversed(records)])
