"""An issue of a run of a campaign, in one line."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CampaignIssue:
    """One mistake in one run, or in two that contradict each other.

    ``refuse``: the campaign must not be solved; otherwise the issue is a flag beside the result.
    """

    run: str
    what: str
    remedy: str
    refuse: bool

    @property
    def line(self) -> str:
        """Run, mistake and remedy in one line."""
        return f"run {self.run}: {self.what} - {self.remedy}"
