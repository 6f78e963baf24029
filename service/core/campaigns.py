"""A full campaign that a person starts: a job with the machine to itself, at whose end a proposal waits, or the reason why there is none.

Whether he may is asked by the book of jobs. Who started it and how it ended stands in the audit. Nothing is approved or written here.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial

import structlog

from abbe.service.audit.book import AuditBook
from abbe.service.audit.chain import Event
from abbe.service.core.jobs import BY_HAND, ByHand, FullCampaigns
from abbe.service.core.rights import person
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import AbbeError, Aborted, Stopped
from abbe.service.events import Progress, ProgressSink
from abbe.service.jobs.guided_campaign import CampaignOutcome, is_full
from abbe.service.scheduler import record
from abbe.service.scheduler.job import FAILURES
from abbe.service.scheduler.ports import JobWatcher, SlotState
from abbe.service.sequences.control import Control, State

log = structlog.get_logger("abbe.campaign")

KIND = "campaign"
LAST_WORDS_S = 1.0
"""A service that ends has five seconds for everything."""


@dataclass(frozen=True, slots=True)
class CampaignOrder:
    """What is wanted: the recipe, who proposes, who is told how far it is, and who may pause and stop it."""

    recipe: str
    by: str
    progress: ProgressSink
    control: Control


MeasureCampaign = Callable[[CampaignOrder], Awaitable[CampaignOutcome]]
"""``await measure(order)``: measures, solves, proposes."""


class CampaignJobs:
    """Carries full campaigns out as jobs.

    Parameters
    ----------
    machine : str
        Its name.
    names : tuple of str
        What can be started.
    measure : callable
        Does it.
    audit : AuditBook
        Where start and end are written down.
    watchers : sequence of JobWatcher
        Who watches jobs.
    """

    def __init__(
        self, machine: str, names: tuple[str, ...], measure: MeasureCampaign, audit: AuditBook, watchers: Sequence[JobWatcher] = ()
    ) -> None:
        self._machine, self._names, self._measure = machine, names, measure
        self._audit, self._watchers = audit, tuple(watchers)

    def full(self, may: Callable[[str], Awaitable[bool]]) -> FullCampaigns:
        """What the book of jobs is told of them. ``await may(who)``: whether somebody may propose tables."""
        return FullCampaigns(self._names, self._of, may)

    def _of(self, recipe: str, who: str) -> ByHand | None:
        return partial(self._carried_out, recipe, who) if is_full(recipe, self._names) else None

    async def _carried_out(self, recipe: str, who: str, begun: datetime, control: Control) -> tuple[str, int | None]:
        control.now(State.RUNNING)
        for watcher in self._watchers:
            watcher.job_started(Schedule(BY_HAND, "", "UTC", recipe), begun)
        try:
            await self._record(recipe, who, "begun", "")
            led = await control.unless_aborted(self._led(CampaignOrder(recipe, person(who), self._progress, control)))
        except asyncio.CancelledError:
            await self._stopped_with_the_service(recipe, who)
            raise
        except FAILURES as error:
            led = _failed(error)
        except ExceptionGroup as group:  # devices that are watched side by side; one unknown member makes all of it a defect
            if group.split(FAILURES)[1] is not None:
                raise
            led = _failed(group)
        finally:
            control.now(State.ENDED)
            for watcher in self._watchers:
                watcher.job_ended(None)
        log.info("a campaign has ended", recipe=recipe, who=who, word=led.word, text=led.text)
        try:
            await self._record(recipe, who, led.word, led.text)
        except AbbeError as error:  # what was measured and proposed is in the store; a service that ends here would do nothing more
            log.error("not in the audit", cause=error.detail)
        return SlotState(f"done: {led.word}", led.text, led.solution, led.proposal), None

    async def _led(self, order: CampaignOrder) -> CampaignOutcome:
        return await self._measure(order)

    def _progress(self, progress: Progress) -> None:
        for watcher in self._watchers:
            watcher.job_progress(progress)

    async def _record(self, recipe: str, who: str, outcome: str, text: str) -> None:
        event = Event(who, KIND, f"{self._machine}, {recipe}", outcome, {"text": text} if text else {})
        await asyncio.to_thread(self._audit.write, event)

    async def _stopped_with_the_service(self, recipe: str, who: str) -> None:
        try:
            async with asyncio.timeout(LAST_WORDS_S):
                await self._record(recipe, who, "stopped", "stopped with the service; what is complete stays")
        except (AbbeError, TimeoutError) as trouble:
            log.warning("a campaign was stopped with the service", cause=str(trouble))


def _failed(error: Exception) -> CampaignOutcome:
    """What a person is told of a campaign that was ended, or could not go on: cause, and how to go on."""
    ended = isinstance(error, Stopped | Aborted)
    cause = record.cause_of(error)
    words = [cause["what"], "" if ended else cause["remedy"], *getattr(error, "__notes__", [])]
    return CampaignOutcome("stopped" if ended else "failed", "; ".join(filter(None, words)))
