"""The interface against its own OpenAPI document, as everybody, over a real server: nothing but what is declared is answered.

``ABBE_TEST_LONG=1`` sends 5,000 requests as each role instead of 100.
"""

from __future__ import annotations

import copy
import os
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from typing import Any

import pytest
import requests
import schemathesis
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import APIOperation, Case, GenerationMode
from schemathesis.specs.openapi.checks import negative_data_rejection

from abbe.service.domain.people import Role
from tests.service.web.api_bench import Plant, open_plant, served

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
BUDGET = 5_000 if LONG else 100
WHO = [*map(str, Role), "anonymous"]

pytestmark = pytest.mark.timeout(3600 if LONG else 400)


@dataclass
class Tally:
    """What was sent and answered."""

    sent: int = 0
    statuses: Counter[int] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    asked: set[str] = field(default_factory=set)


Tallies = dict[str, Tally]


@dataclass(frozen=True)
class Ask:
    """What is asked: an operation, by its rules or against them."""

    operation: APIOperation[Any, Any]
    mode: GenerationMode
    turn: int


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    with open_plant(tmp_path_factory) as found:
        yield found


@pytest.fixture(scope="module")
def address(plant: Plant) -> Iterator[str]:
    with served(plant.app) as url:
        yield url


def operations(plant: Plant, address: str) -> list[APIOperation[Any, Any]]:
    document = copy.deepcopy(plant.app.openapi())
    # Who may ask is the business of the matrix of rights. Here every request says who asks: a token that is changed would be changed back.
    del document["components"]["securitySchemes"]
    for methods in document["paths"].values():
        for operation in methods.values():
            operation.pop("security", None)
    schema = schemathesis.openapi.from_dict(document)
    schema.config.update(base_url=address)
    return [found.ok() for found in schema.get_all_operations()]


def unfit(case: Case) -> list[Any]:
    """An object in the query is nothing in an URL: what was made wrong by it arrives as a request that is right."""
    scalar = all(isinstance(value, str | int | float | bool) for value in dict(case.query or {}).values())
    return [] if scalar else [negative_data_rejection]


def send(ask: Ask, count: int, sessions: dict[str, requests.Session], tally: Tallies) -> None:
    """So many requests of one kind, each by everybody; what is wrong with the answers is kept."""

    @seed(ask.turn)  # another turn is other requests, and every run has the same
    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        derandomize=False,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=ask.operation.as_strategy(generation_mode=ask.mode))
    def one(case: Case) -> None:
        for who, session in sessions.items():
            answer = case.call(session=session)
            tally[who].sent += 1
            tally[who].asked.add(case.operation.label)
            tally[who].statuses[answer.status_code] += 1
            try:
                case.validate_response(answer, excluded_checks=unfit(case), transport_kwargs={"session": session})
            except BaseException as fault:  # noqa: BLE001 - schemathesis groups failures of several checks
                what = f"{case.method} {case.formatted_path} {case.query} {case.body}: {answer.status_code} {fault!r}"
                tally[who].faults.append(what[:2000])

    with suppress(Unsatisfiable):  # nothing can be wrong with a request without parameters
        one()


def test_only_declared_answers(plant: Plant, address: str, capsys: pytest.CaptureFixture[str]) -> None:
    tally, found = {who: Tally() for who in WHO}, operations(plant, address)
    with ExitStack() as stack:
        sessions = {who: stack.enter_context(requests.Session()) for who in WHO}
        for who, session in sessions.items():
            session.headers.update({} if who == "anonymous" else plant.token(who))
        # What takes no parameters has one request only; the others make up for it.
        each = -(-BUDGET // sum(2 if operation.path_parameters or operation.query else 1 for operation in found))
        turn = 0
        while min(one.sent for one in tally.values()) < BUDGET:
            turn += 1
            for operation in found:
                for mode in (GenerationMode.POSITIVE, GenerationMode.NEGATIVE):
                    send(Ask(operation, mode, turn), each, sessions, tally)
    if LONG:
        with capsys.disabled():
            for who, one in tally.items():
                told = f"{one.sent} requests, {dict(sorted(one.statuses.items()))}, {len(one.faults)} undeclared"
                sys.stdout.write(f"\n{who}: {told}")
    assert not any(one.faults for one in tally.values()), "\n".join(fault for one in tally.values() for fault in one.faults[:9])
    assert {status for one in tally.values() for status in one.statuses if status >= 500} == set()
    assert all(one.sent >= BUDGET for one in tally.values())
    assert all(one.asked == {operation.label for operation in found} for one in tally.values())
    assert all(one.statuses[200] > 0.1 * one.sent for who, one in tally.items() if who != "anonymous")
    assert set(tally["anonymous"].statuses) <= {200, 401, 404, 405}
