"""MTConnect at ``/mtconnect/probe``, ``/current`` and ``/sample``, with the permission of the home page."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from fastapi import FastAPI, Request
from fastapi.responses import Response

from abbe.service.domain.people import Permission
from abbe.service.plant.gather import FactsSource, PlantFacts
from abbe.service.plant.mtconnect import Agent, MtconnectRefusal
from abbe.service.web.login.access import needs

MEDIA_TYPE = "text/xml"


class MtconnectAccess:
    """The agent and its source of facts. The first request starts the agent; the time of that request becomes the ``instanceId``."""

    def __init__(self, source: FactsSource) -> None:
        self._source = source
        self._agent: Agent | None = None

    async def answer(self, request: Request, write: Callable[[Agent, PlantFacts, Mapping[str, str]], bytes]) -> Response:
        """The requested document, or an Error document."""
        facts = await self._source.facts()
        if self._agent is None:
            self._agent = Agent(int(facts.now_utc.timestamp()))
        self._agent.update(facts)
        try:
            return Response(write(self._agent, facts, request.query_params), media_type=MEDIA_TYPE)
        except MtconnectRefusal as refused:
            return Response(self._agent.error(refused, facts.now_utc), refused.status, media_type=MEDIA_TYPE)


def add_mtconnect(app: FastAPI, source: FactsSource) -> None:
    """Add the three routes. OpenAPI omits them, since MTConnect describes them."""
    access = MtconnectAccess(source)

    @app.get("/mtconnect/probe", include_in_schema=False)
    @needs(Permission.READ)
    async def probe(request: Request) -> Response:
        return await access.answer(request, lambda agent, facts, _: agent.probe(facts))

    @app.get("/mtconnect/current", include_in_schema=False)
    @needs(Permission.READ)
    async def current(request: Request) -> Response:
        return await access.answer(request, lambda agent, facts, query: agent.current(facts, query))

    @app.get("/mtconnect/sample", include_in_schema=False)
    @needs(Permission.READ)
    async def sample(request: Request) -> Response:
        return await access.answer(request, lambda agent, facts, query: agent.sample(facts, query))
