"""Abbe determines how a 3-axis machine really moves, and corrects it.

This is the public interface (decision 0035): the names below are documented and stable; everything else is private. Lengths are in mm,
angles in rad, times in s, unless a name says otherwise. The subpackages are links to the folders beside this one (decision 0031).

    campaign = abbe.read_campaign("june/")
    solution = abbe.solve(campaign)
    answer = abbe.discover(campaign)
    runs = abbe.simulate(machine, abbe.plan(machine).campaign, errors)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from abbe.models.compensation.tables import NineTables as NineTables
    from abbe.models.effects import columns as columns
    from abbe.models.effects.effect import Effect as Effect
    from abbe.models.effects.effect import Form as Form
    from abbe.models.effects.effect import Parameter as Parameter
    from abbe.models.effects.path import Path as Path
    from abbe.models.effects.path import Places as Places
    from abbe.models.functions.legendre import Legendre as Legendre
    from abbe.models.functions.motions import ErrorMotions as ErrorMotions
    from abbe.models.functions.polynomial import Polynomial as Polynomial
    from abbe.models.functions.table import Table as Table
    from abbe.models.machine import Machine as Machine
    from abbe.public.answers import Estimate as Estimate
    from abbe.public.answers import Picture as Picture
    from abbe.public.campaign import read_campaign as read_campaign
    from abbe.public.campaign import read_errors as read_errors
    from abbe.public.discovery import DiscoveryAnswer as DiscoveryAnswer
    from abbe.public.discovery import discover as discover
    from abbe.public.planning import Plan as Plan
    from abbe.public.planning import plan as plan
    from abbe.public.simulation import SimulatedInstruments as SimulatedInstruments
    from abbe.public.simulation import simulate as simulate
    from abbe.public.solution import Deviation as Deviation
    from abbe.public.solution import Solution as Solution
    from abbe.public.solution import solve as solve
    from abbe.service.campaign_data.campaign_folder import Campaign as Campaign
    from abbe.service.errors import AbbeError as AbbeError
    from abbe.service.sequences.recipes.campaigns import discovery_campaign as discovery_campaign
    from abbe.service.sequences.recipes.campaigns import identification as identification
    from abbe.service.sequences.recipes.campaigns import verification as verification
    from abbe.service.sequences.recipes.recipe import Circle as Circle
    from abbe.service.sequences.recipes.recipe import Diagonal as Diagonal
    from abbe.service.sequences.recipes.recipe import Helix as Helix
    from abbe.service.sequences.recipes.recipe import Linear as Linear
    from abbe.service.sequences.steps import CampaignPlan as CampaignPlan

_WHERE = {
    "AbbeError": "abbe.service.errors",
    "DiscoveryAnswer": "abbe.public.discovery",
    "Campaign": "abbe.service.campaign_data.campaign_folder",
    "CampaignPlan": "abbe.service.sequences.steps",
    "Circle": "abbe.service.sequences.recipes.recipe",
    "Deviation": "abbe.public.solution",
    "Diagonal": "abbe.service.sequences.recipes.recipe",
    "Effect": "abbe.models.effects.effect",
    "ErrorMotions": "abbe.models.functions.motions",
    "Estimate": "abbe.public.answers",
    "Form": "abbe.models.effects.effect",
    "Helix": "abbe.service.sequences.recipes.recipe",
    "SimulatedInstruments": "abbe.public.simulation",
    "Legendre": "abbe.models.functions.legendre",
    "Linear": "abbe.service.sequences.recipes.recipe",
    "Machine": "abbe.models.machine",
    "NineTables": "abbe.models.compensation.tables",
    "Parameter": "abbe.models.effects.effect",
    "Path": "abbe.models.effects.path",
    "Picture": "abbe.public.answers",
    "Plan": "abbe.public.planning",
    "Places": "abbe.models.effects.path",
    "Polynomial": "abbe.models.functions.polynomial",
    "Solution": "abbe.public.solution",
    "Table": "abbe.models.functions.table",
    "columns": "abbe.models.effects.columns",
    "discover": "abbe.public.discovery",
    "discovery_campaign": "abbe.service.sequences.recipes.campaigns",
    "identification": "abbe.service.sequences.recipes.campaigns",
    "plan": "abbe.public.planning",
    "read_campaign": "abbe.public.campaign",
    "read_errors": "abbe.public.campaign",
    "simulate": "abbe.public.simulation",
    "solve": "abbe.public.solution",
    "verification": "abbe.service.sequences.recipes.campaigns",
}
"""Module of each public name. It is imported at first use, so that a command imports only what it needs."""

__all__ = list(_WHERE)


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'abbe' has no attribute {name!r}")
    module = import_module(_WHERE[name])
    found = module if _WHERE[name].endswith(f".{name}") else getattr(module, name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_WHERE})
