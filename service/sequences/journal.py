"""The journal of a campaign: what cannot be undone is written down, so that another process can go on.

Kinds of lines: ``begun`` (plan's hash and source, controller's boot id, table, process), ``hand`` (a person was asked, and when it was
done), ``run`` (a run of a test was opened), ``point`` (a point was read), ``done`` (a test is complete), ``waits`` and ``goes-on`` (pause,
suspension), ``incident`` (trouble on a link was noticed, or is over), ``ended``. ``docs/decisions/0016-checkpoints.md`` says what each is
good for.
"""

from __future__ import annotations

import asyncio
from typing import Any, Protocol

from abbe.service.capture.ingest import may_pass
from abbe.service.capture.recorder import CATCH_UP_S
from abbe.service.errors import StoreError
from abbe.service.storage.store import Store

BEGUN, HAND, RUN, POINT, DONE, WAITS, GOES_ON, ENDED = "begun", "hand", "run", "point", "done", "waits", "goes-on", "ended"
INCIDENT = "incident"
DETECTED, OUTCOME = "detected", "outcome"
"""The two lines of an incident: it is noticed, and how it ended."""


LONGEST_S = CATCH_UP_S
"""As long as samples may wait for the database."""
AGAIN_S = 0.2


class Journal(Protocol):
    """Where checkpoints go."""

    async def add(self, kind: str, **doc: Any) -> None:
        """Write a line. On return it is on disk."""
        ...


class StoreJournal:
    """The journal in the database."""

    def __init__(self, store: Store, campaign_id: int, longest_s: float = LONGEST_S) -> None:
        self._store, self.campaign, self.longest_s = store, campaign_id, longest_s

    async def add(self, kind: str, **doc: Any) -> None:
        """Write a line. On return it is on disk. A database that is locked is asked again for `LONGEST_S`; the axes stand meanwhile.

        Raises
        ------
        StoreError
            It did not take the line.
        """
        clock = asyncio.get_running_loop().time
        until_s = clock() + self.longest_s
        while True:
            try:
                await self._store.write(self._store.checkpoints.add, self.campaign, kind, doc)
                return
            except StoreError as error:
                if not may_pass(error) or clock() > until_s:
                    raise
            await asyncio.sleep(AGAIN_S)


class NoJournal:
    """For tests that nobody goes on with."""

    async def add(self, kind: str, **doc: Any) -> None:
        """Nothing."""
