"""Where the steps from an alarm to a report lead: to the screen of what exists, or to what is to be done."""

from __future__ import annotations

from urllib.parse import urlencode

from abbe.service.queries.alarm_path import PathStep
from abbe.service.sequences.recipes.campaigns import IDENTIFICATION

SCREENS = {
    "alarm": "/alarm?id={}",
    "check": "/check?id={}",
    "cause": "/discovery?id={}",
    "proposal": "/proposal?id={}",
    "approval": "/proposal?id={}",
    "push": "/table#push-{}",
    "proof": "/check?id={}",
    "report": "/api/v1/reports/verification/{}",
}


def step_address(step: PathStep, to_do: bool = False) -> str:
    """Address of a step; ``to_do``: of what the step asks for. Empty: nothing exists yet."""
    if to_do and step.key in {"cause", "proposal", "proof"}:
        return "/new?" + urlencode({"recipe": step.recipe or IDENTIFICATION})
    if step.number is None or (step.key == "report" and step.state != "now"):
        return ""
    return SCREENS[step.key].format(step.number)
