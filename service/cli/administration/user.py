"""`abbe user`: users of the pages and the HTTP interface, and their roles; `abbe key`: keys that sign compensation files."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import (
    DbOption,
    JsonOption,
    MachineOption,
    answer,
    conclude,
    database_url,
    open_store,
    print_json,
    print_table,
    warn_of_readers,
)

if TYPE_CHECKING:
    from abbe.service.storage.store import Store
    from abbe.service.users.people import UserAccounts


user = typer.Typer(help="Users of the pages and the HTTP interface: viewer, operator, metrologist, approver, admin.", no_args_is_help=True)
token = typer.Typer(help="Tokens for programs: each gives the rights in its scopes, as far as its user has them.", no_args_is_help=True)
user.add_typer(token, name="token")

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the user.", show_default=False)]
RoleArgument = Annotated[str, typer.Argument(metavar="ROLE", help="viewer, operator, metrologist, approver or admin.", show_default=False)]


@user.command("add")
def add_user(name: Name, role: RoleArgument, db: DbOption = None, machine: MachineOption = None, as_json: JsonOption = False) -> None:
    """Add a user. The password is asked for, or read from the first line of standard input."""
    with _people(db, machine, must_exist=False) as (people, _):
        people.add(name, role, _password())
    _said(name, f"user {name!r} is {role}", (db, machine), as_json=as_json)


@user.command("list")
def list_users(db: DbOption = None, machine: MachineOption = None, as_json: JsonOption = False) -> None:
    """List users with their roles."""
    from abbe.service.queries.people import users
    from abbe.service.queries.reader import json_value

    with _people(db, machine) as (_, store):
        found = users(store)
    if as_json:
        print_json([json_value(one) for one in found])
        return
    rows = [(u.name, u.role, u.created_utc[:19], (u.disabled_utc or "")[:19]) for u in found]
    print_table(("name", "role", "since (UTC)", "disabled (UTC)"), rows)
    then = "abbe user token list" if found else "abbe user add ADMIN admin"
    conclude(then, machine=machine, db=db, verdict=f"{len(found)} users, {sum(not u.disabled_utc for u in found)} may log in")


@user.command("role")
def set_role(name: Name, role: RoleArgument, db: DbOption = None, machine: MachineOption = None, as_json: JsonOption = False) -> None:
    """Give a user another role. The user's sessions end; tokens keep those of their scopes that the new role allows."""
    with _people(db, machine) as (people, _):
        people.set_role(name, role)
    _said(name, f"user {name!r} is {role}", (db, machine), as_json=as_json)


@user.command("password")
def set_password(name: Name, db: DbOption = None, machine: MachineOption = None, as_json: JsonOption = False) -> None:
    """Give a user another password: asked for, or read from standard input. The user's sessions end."""
    with _people(db, machine) as (people, _):
        people.get(name)
        people.set_password(name, _password())
    _said(name, f"user {name!r} has a new password", (db, machine), as_json=as_json)


@user.command("disable")
def disable_user(name: Name, db: DbOption = None, machine: MachineOption = None, as_json: JsonOption = False) -> None:
    """Disable a user at once, with sessions and tokens. Users are not deleted: the audit names them."""
    with _people(db, machine) as (people, _):
        people.disable(name)
    _said(name, f"user {name!r} is disabled", (db, machine), as_json=as_json)


@user.command("enable")
def enable_user(name: Name, db: DbOption = None, machine: MachineOption = None, as_json: JsonOption = False) -> None:
    """Enable a disabled user."""
    with _people(db, machine) as (people, _):
        people.disable(name, enable=True)
    _said(name, f"user {name!r} may log in", (db, machine), as_json=as_json)


@token.command("new")
def new_token(
    name: Name,
    title: Annotated[str, typer.Argument(metavar="TOKEN", help="Name of the token.", show_default=False)],
    scope: Annotated[list[str], typer.Option("--scope", help="A right for the token, which the user must have; may be repeated.")],
    days: Annotated[float, typer.Option("--days", help="How long the token is valid, days.")] = 90.0,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Create a token and print it, once: only its hash is stored."""
    with _people(db, machine) as (people, _):
        text = people.add_token(name, title, scope, days)
    answer({"user": name, "token": title, "text": text}, text, as_json=as_json)
    conclude("abbe user token list", machine=machine, db=db, as_json=as_json)


@token.command("list")
def list_tokens(db: DbOption = None, machine: MachineOption = None, as_json: JsonOption = False) -> None:
    """List tokens: user, scopes, expiry."""
    from abbe.service.queries.people import tokens
    from abbe.service.queries.reader import json_value

    with _people(db, machine) as (_, store):
        found = tokens(store)
    if as_json:
        print_json([json_value(one) for one in found])
        return
    rows = [(t.user, t.token, t.prefix, ", ".join(t.scopes), t.expires_utc[:19], (t.revoked_utc or "")[:19]) for t in found]
    print_table(("user", "token", "begins with", "scopes", "until (UTC)", "revoked (UTC)"), rows)
    valid = [t for t in found if not t.revoked_utc]
    then = f"abbe user token revoke {quote(valid[0].user)} {quote(valid[0].token)}" if valid else "abbe user list"
    conclude(then, machine=machine, db=db, verdict=f"{len(found)} tokens, {len(valid)} not revoked")


@token.command("revoke")
def revoke_token(
    name: Name,
    title: Annotated[str, typer.Argument(metavar="TOKEN", help="Name of the token.", show_default=False)],
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Revoke a token, at once and permanently."""
    with _people(db, machine) as (people, _):
        people.revoke_token(name, title)
    text = f"token {title!r} of {name!r} is revoked"
    answer({"user": name, "token": title, "text": text}, text, as_json=as_json)
    conclude("abbe user token list", machine=machine, db=db, as_json=as_json)


def _said(name: str, text: str, where: tuple[str | None, Path | None], *, as_json: bool) -> None:
    answer({"user": name, "text": text}, text, as_json=as_json)
    conclude("abbe user list", db=where[0], machine=where[1], as_json=as_json)


@contextmanager
def _people(db: str | None, machine: Path | None, *, must_exist: bool = True) -> Iterator[tuple[UserAccounts, Store]]:
    from abbe.service.clock import SystemClock
    from abbe.service.users.people import UserAccounts

    url = database_url(db, machine)
    with open_store(url, must_exist=must_exist) as store:
        warn_of_readers(url)
        yield UserAccounts(store, SystemClock()), store


def _password() -> str:
    """Read a password: typed twice and hidden at a terminal, else the first line of stdin. An argument would be visible to other users."""
    from abbe.service.errors import PasswordRefused

    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\r\n")
    import getpass

    first = getpass.getpass("password: ")
    if getpass.getpass("again: ") != first:
        raise PasswordRefused("the two passwords differ", "type it again")
    return first


key = typer.Typer(help="Keys that sign compensation files.", no_args_is_help=True)


@key.command("new")
def new(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="New file for the private key.", show_default=False)],
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Create a key pair. FILE gets the private key, readable by its owner only; list the printed key under [signatures] trusted."""
    from abbe.service.signed.keys import new_key

    public = new_key(file)
    answer({"file": str(file), "public_key": public}, public, as_json=as_json)
    conclude("abbe check-config", machine=machine, as_json=as_json)
