"""One thing that is wrong with a run of a campaign, in one line."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CampaignIssue:
    """One thing that is wrong with one run (or with two that contradict each other).

    ``refuse``: nothing may be solved from such a campaign; otherwise it is a flag beside the result.
    """

    run: str
    what: str
    remedy: str
    refuse: bool

    @property
    def line(self) -> str:
        """One line for people."""
        return f"run {self.run}: {self.what} - {self.remedy}"
