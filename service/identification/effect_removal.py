"""Subtract the effects that a table cannot correct from the readings before tables are made, and name the remedy of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from abbe.models.arrays import F1
from abbe.models.effects.effect import Effect
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.campaign_data.provenance import machine_digest, with_changed_readings
from abbe.service.domain.finding import EffectSize
from abbe.service.domain.run import Run
from abbe.service.domain.solution_file import TableRemoval
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.effects.model_book import applies, current, no_table_lines, readings_of
from abbe.service.identification.table_removal import CampaignTable, remove_table
from abbe.service.runs.cases import case_of
from abbe.service.storage.store import Store

IN_U = "U includes what a table of usual size may have done"


@dataclass(frozen=True)
class RemovedEffects:
    """A campaign without the effects that tables cannot correct.

    ``labels``: the subtracted effects; ``lines``: every effect that a table cannot correct, with its remedy, or why the model book was not
    used; ``version``: of the book, None without one; ``in_force``: the active table whose side effects were subtracted
    (`abbe.service.identification.table_removal.remove_table`), None without one; ``not_removed``: why the side effects of a table remain
    in the readings, which the assessment of a solution needs, empty otherwise.
    """

    campaign: Campaign
    labels: tuple[str, ...]
    lines: tuple[str, ...]
    version: int | None
    in_force: TableRemoval | None = None
    not_removed: str = ""

    @property
    def doc(self) -> dict[str, Any]:
        """Part of a solution's document; empty without a book and without a table."""
        doc: dict[str, Any] = {} if self.in_force is None else {"table_taken_out": self.in_force.model_dump(mode="json")}
        doc |= {"table_not_taken_out": self.not_removed} if self.not_removed else {}
        if self.version is None:
            return doc
        return doc | {"machine_model": {"version": self.version, "taken_out": list(self.labels), "not_for_tables": list(self.lines)}}


def remove_effects(
    store: Store | None, campaign: Campaign, table: CampaignTable, effects: tuple[Effect, ...] | None = None
) -> RemovedEffects:
    """Subtract effects that tables cannot correct from a campaign's readings.

    These are the effect of ``table``, active during the measurement, beyond smooth corrections, and those effects of the machine's current
    model that apply to this campaign and whose remedy is not a table. Without a ``store`` there is no such model.

    Raises
    ------
    CampaignRefused
        A table was active, and the data of a run contradict its description.
    ModelUnknown
        The book contains an effect that is not in the catalogue.
    """
    left = remove_table(campaign, table.table)
    return replace(_without_book_effects(store, left, effects), in_force=left.removed, not_removed=table.why and f"{table.why}; {IN_U}")


def _without_book_effects(store: Store | None, campaign: Campaign, effects: tuple[Effect, ...] | None) -> RemovedEffects:
    record = None if store is None else current(store, campaign.site.name)
    if record is None:
        return RemovedEffects(campaign, (), (), None)
    if record.book.machine_digest != machine_digest(campaign.site.machine):
        line = f"model version {record.version} of {campaign.site.name} is for another geometry and was not used"
        return RemovedEffects(campaign, (), (line,), record.version)
    chosen = [e for e in record.book.effects if e.remedy != "table" and applies(e, campaign.name)]
    lines = tuple(no_table_lines(record))
    if not chosen:
        return RemovedEffects(campaign, (), lines, record.version)
    left = subtract_effects(campaign, chosen, f"model version {record.version}", effects)
    return RemovedEffects(left, tuple(e.label for e in chosen), lines, record.version)


def subtract_effects(campaign: Campaign, entries: Sequence[EffectSize], origin: str, effects: tuple[Effect, ...] | None = None) -> Campaign:
    """Subtract the contribution of named effects from a campaign's readings; ``origin``: their origin, for the record of each run.

    Raises
    ------
    ModelUnknown
        An effect is not in the catalogue.
    """
    if not entries:
        return campaign
    case = case_of(campaign.doc, campaign.site.machine, campaign.runs)
    known_mm = readings_of(entries, effects or catalogue(), case)
    removed = f"{origin}: {', '.join(e.label for e in entries)}"
    return replace(campaign, runs=[run if run.is_artefact else _subtracted(run, known_mm[run.run_id], removed) for run in campaign.runs])


def _subtracted(run: Run, known_mm: F1, removed: str) -> Run:
    return run if run.is_sealed else with_changed_readings(run, run.columns.readings_mm - known_mm, removed)
