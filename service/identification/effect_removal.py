"""What a table cannot take out is taken out of the readings before tables are made from them, and named with its remedy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from abbe.models.effects.effect import Effect
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.campaign_data.provenance import changed, machine_digest
from abbe.service.domain.finding import EffectSize
from abbe.service.domain.solution_file import TableTakenOut
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.effects.known_effects import applies, readings_of
from abbe.service.effects.model_book import current, no_table_lines
from abbe.service.identification.table_removal import TableThen, as_left
from abbe.service.runs.cases import case_of
from abbe.service.storage.store import Store


@dataclass(frozen=True)
class TakenOut:
    """Runs without what the model book says is no matter for tables.

    ``labels``: the effects that were taken out of the readings; ``lines``: every effect that a table cannot take out, with its remedy, or
    why the book was not used; ``version``: of the model, None without a book; ``in_force``: the table whose side effects were taken out
    (`abbe.service.identification.table_removal.as_left`), None for none; ``not_taken``: why those of a table are still in the readings,
    empty if they are not.
    """

    campaign: Campaign
    labels: tuple[str, ...]
    lines: tuple[str, ...]
    version: int | None
    in_force: TableTakenOut | None = None
    not_taken: str = ""

    @property
    def doc(self) -> dict[str, Any]:
        """For the document of a solution; empty without a book and without a table."""
        told: dict[str, Any] = {} if self.in_force is None else {"table_taken_out": self.in_force.model_dump(mode="json")}
        told |= {"table_not_taken_out": self.not_taken} if self.not_taken else {}
        if self.version is None:
            return told
        return told | {"machine_model": {"version": self.version, "taken_out": list(self.labels), "not_for_tables": list(self.lines)}}


def taken_out(store: Store, campaign: Campaign, then: TableThen, effects: tuple[Effect, ...] | None = None) -> TakenOut:
    """Take what is no matter for tables out of a campaign's readings.

    That is what the table ``then``, in force while it was measured, did beyond smooth corrections, and lasting effects whose remedy is no
    table, as the machine's current model has them.

    Raises
    ------
    CampaignRefused
        A table was in force, and a run cannot be what it says.
    ModelUnknown
        The book knows an effect that this catalogue does not.
    """
    left = as_left(campaign, then.table)
    return replace(_less_known(store, left, effects), in_force=left.removed, not_taken=then.why)


def _less_known(store: Store, campaign: Campaign, effects: tuple[Effect, ...] | None) -> TakenOut:
    record = current(store, campaign.site.name)
    if record is None:
        return TakenOut(campaign, (), (), None)
    if record.book.machine_digest != machine_digest(campaign.site.machine):
        line = f"model version {record.version} of {campaign.site.name} is of another geometry and was not used"
        return TakenOut(campaign, (), (line,), record.version)
    chosen = [e for e in record.book.effects if e.remedy != "table" and applies(e, campaign.name)]
    lines = tuple(no_table_lines(record))
    if not chosen:
        return TakenOut(campaign, (), lines, record.version)
    left = less_effects(campaign, chosen, f"model version {record.version}", effects)
    return TakenOut(left, tuple(e.label for e in chosen), lines, record.version)


def less_effects(campaign: Campaign, entries: Sequence[EffectSize], whose: str, effects: tuple[Effect, ...] | None = None) -> Campaign:
    """A campaign without what named effects do to its readings; ``whose``: in words, where they are from.

    Raises
    ------
    ModelUnknown
        The catalogue does not know one of them.
    """
    if not entries:
        return campaign
    case = case_of(campaign.doc, campaign.site.machine, campaign.runs)
    known_mm = readings_of(entries, effects or catalogue(), case)
    words = f"{whose}: {', '.join(e.label for e in entries)}"
    return replace(campaign, runs=[_less(run, known_mm[run["run_id"]], words) for run in campaign.runs])


def _less(run: dict[str, Any], known_mm: np.ndarray[Any, np.dtype[np.float64]], words: str) -> dict[str, Any]:
    reading = run["columns"]["deviation_mm"]
    if reading is None:
        return run
    return changed(run, run["columns"] | {"deviation_mm": (np.asarray(reading, dtype=np.float64) - known_mm).tolist()}, words)
