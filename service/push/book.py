"""The durable journal of a push, in the database. An entry is on disk before what it permits; the chain shuts out a second writer."""

from __future__ import annotations

import asyncio

from abbe.service.clock import Clock
from abbe.service.domain.decisions import PushEntryRecord
from abbe.service.domain.utc import utc_text
from abbe.service.errors import UnsafeToMove
from abbe.service.push.entries import GENESIS, NO_PUSH, Doc, Journal, JournalEntry, follow
from abbe.service.push.states import TERMINAL, PushState
from abbe.service.storage.store import Store


class StoreBook:
    """Journal of the last push into one control, or of its next one. Open it with `last`, `new` or `for_acceptance`.

    ``machine``: name of the journal (`Store.pushes.chain`): all pushes into one control share it, whatever the machine is called now.
    ``head``: digest of the last entry in it; ``journal``: entries of this push so far.
    """

    def __init__(self, store: Store, machine: str, clock: Clock, push: int, head: str, journal: Journal) -> None:
        self._store, self._machine, self._clock = store, machine, clock
        self._push, self._head, self._journal = push, head, journal

    @classmethod
    async def last(cls, store: Store, machine: str, clock: Clock, control: str = "") -> StoreBook | None:
        """Journal of the last push of a machine's control, or of acceptances before the first push (`NO_PUSH`); None if there is none."""
        chain = await asyncio.to_thread(store.pushes.chain, machine, control)
        return await cls.of_chain(store, chain, clock)

    @classmethod
    async def of_chain(cls, store: Store, chain: str, clock: Clock) -> StoreBook | None:
        """Journal of the last push in the journal of this name; None if it is empty."""
        entries = await asyncio.to_thread(_entries_of, store, chain)
        if not entries:
            return None
        push = entries[-1].push
        return cls(store, chain, clock, push, entries[-1].digest, tuple(entry for entry in entries if entry.push == push))

    @classmethod
    async def for_acceptance(cls, store: Store, machine: str, clock: Clock, control: str = "") -> StoreBook:
        """Journal for a person's acceptance of the table in force: that of the last push, or `NO_PUSH` before the first."""
        chain = await asyncio.to_thread(store.pushes.chain, machine, control)
        return await cls.of_chain(store, chain, clock) or cls(store, chain, clock, NO_PUSH, GENESIS, ())

    @classmethod
    async def new(cls, store: Store, machine: str, clock: Clock, control: str = "") -> StoreBook:
        """An empty journal for the next push into a machine's control.

        Raises
        ------
        UnsafeToMove
            The last push is unfinished: finish it first.
        """
        chain = await asyncio.to_thread(store.pushes.chain, machine, control)
        book = await cls.of_chain(store, chain, clock)
        if book is None:
            return cls(store, chain, clock, 1, GENESIS, ())
        last = (await book.entries())[-1]
        if last.state not in TERMINAL or last.state is PushState.OPERATOR:
            raise UnsafeToMove(f"push {last.push} of {chain} stands at {last.state}", "finish it first")
        return cls(store, chain, clock, last.push + 1, last.digest, ())

    async def entries(self) -> Journal:
        """The push so far."""
        return self._journal

    async def append(self, journal: Journal, state: PushState, doc: Doc) -> JournalEntry:
        """Write the next entry; on return it is on disk.

        Raises
        ------
        JournalBroken
            This state cannot follow.
        StoreError
            Somebody else has written an entry meanwhile, or the database refuses it.
        """
        entry = follow(journal, self._push, state, doc, utc_text(self._clock.utc()), self._head)
        row = PushEntryRecord(
            machine=self._machine,
            push=entry.push,
            seq=entry.seq,
            state=str(entry.state),
            doc=entry.doc,
            utc=entry.utc,
            prev=entry.prev,
            digest=entry.digest,
        )
        await self._store.write(self._store.pushes.append, row)
        self._head, self._journal = entry.digest, (*journal, entry)
        return entry


def read_entries(store: Store, machine: str, control: str = "") -> list[JournalEntry]:
    """All entries of all pushes into a machine's control, whatever the machine was called; ``control`` empty: by the name alone."""
    return [_entry(r) for r in store.pushes.entries(machine, control)]


def _entries_of(store: Store, chain: str) -> list[JournalEntry]:
    return [_entry(r) for r in store.pushes.entries_of(chain)]


def _entry(r: PushEntryRecord) -> JournalEntry:
    return JournalEntry(r.push, r.seq, PushState(r.state), r.doc, r.utc, r.prev, r.digest)
