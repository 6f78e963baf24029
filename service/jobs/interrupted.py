"""The last campaign of a recipe, if it was interrupted and can be completed."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from abbe.service.domain.measured import CheckpointRecord
from abbe.service.domain.service_records import AlarmKind
from abbe.service.sequences.journal import BEGUN, ENDED, BegunLine, lines_of
from abbe.service.sequences.recipes.campaigns import RecipeSource
from abbe.service.storage.store import Store
from abbe.service.verification.alarm_states import Alarm, folded, step_of_order

LATEST = 20
"""How many of the newest campaigns are looked at; an older one has been followed by days of checks."""
COMPLETE = "complete"


@dataclass(frozen=True, slots=True, kw_only=True)
class InterruptedCampaign:
    """An interrupted campaign.

    ``rate_hz``: ball-bar samples per second; ``complete``: number of its complete runs, which are kept; ``until_utc``: when it was
    interrupted; ``alarm``: the alarm whose cause it looks for, 0 if none.
    """

    name: str
    recipe: str
    rate_hz: int
    complete: int
    until_utc: datetime
    alarm: int


def interrupted_campaign(store: Store, machine: str, recipe: str) -> InterruptedCampaign | None:
    """Return a machine's last campaign of a recipe; None if it was completed, is being measured, or has no complete run."""
    for row in store.pages.page("campaigns", {"machine": machine}, None, LATEST):
        journal = store.checkpoints.of_campaign(row.number)
        begun = lines_of(journal, BegunLine)
        source = RecipeSource(**begun[-1].source) if begun and "recipe" in begun[-1].source else None
        if source is None or source.recipe != recipe:
            continue
        complete = sum(run.visible_status == COMPLETE for run in store.runs.all(row.number))
        if not complete or not _is_interrupted(journal, begun[-1]):
            return None
        campaign = store.campaigns.find(row.number).name
        return InterruptedCampaign(
            name=campaign,
            recipe=recipe,
            rate_hz=source.rate_hz,
            complete=complete,
            until_utc=datetime.fromisoformat(journal[-1].utc),
            alarm=next((one.number for one in folded(store.alarms.entries(machine)) if _looks_for(one, campaign)), 0),
        )
    return None


def _is_interrupted(journal: list[CheckpointRecord], begun: BegunLine) -> bool:
    last = max(k for k, one in enumerate(journal) if one.kind == BEGUN)
    ended = next((one for one in journal[last:] if one.kind == ENDED), None)
    if ended is not None:
        return bool(ended.doc.get("how") != COMPLETE)
    return begun.owner is not None and begun.owner.is_gone()


def _looks_for(alarm: Alarm, campaign: str) -> bool:
    begun = alarm.last(AlarmKind.BEGUN)
    return alarm.active and begun is not None and begun.facts.campaign == campaign and step_of_order(alarm) is AlarmKind.MEASURED
