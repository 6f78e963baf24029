"""Campaigns of artefacts: errors that move with the part, errors of the machine, and the pose that would separate the rest."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from abbe.models.solvers.artefact_motion import fine_of
from abbe.models.solvers.artefact_shares import Share, field_shares
from abbe.models.solvers.engine import DEFAULT_SIGMA_MM
from abbe.models.solvers.fine import sure_periods
from abbe.models.solvers.observability.poses import PoseRank, pose_rank
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.identification.artefact_answer import artefact_lines
from abbe.service.identification.solve import Solved, solve_runs

FORMAT = "abbe-artefact-finding/1"
LEFT = 2.0
"""Points that scatter by more than this multiple of their repeatability have an error that neither part nor machine explains."""


@dataclass(frozen=True, eq=False)
class ArtefactFinding:
    """What a campaign of artefacts shows of part and machine.

    ``rank``: the error fields that the poses show, None unless one plate lay in several poses in a plane; ``shares``: the part's and the
    machine's amount of each field, empty if ``rank`` is None. ``waves``: sure periods of the machine's motions. ``scatter``: scatter of
    the points as a multiple of their repeatability.
    """

    campaign: str
    solved: Solved
    rank: PoseRank | None
    shares: tuple[Share, ...]
    waves: tuple[str, ...]
    scatter: float

    @property
    def verdict(self) -> str:
        """Verdict: errors that move with the part, errors of the machine, and errors that these poses do not separate."""
        if self.rank is None:
            return "unknown: only one plate in one plane gives errors a name; the solution separates part and machine point by point"
        said = [
            f"{where}: {', '.join(found)}"
            for where, words in (
                ("moves with the part", ("with the part", "with both")),
                ("stays with the machine", ("with the machine", "with both")),
                ("unknown, part or machine", ("unknown",)),
            )
            if (found := [s.field for s in self.shares if s.verdict in words] + list(self.waves if where.startswith("stays") else ()))
        ]
        if self.scatter > LEFT:
            said.append(f"explained by neither part nor machine: points scatter {self.scatter:.1f} times their repeatability")
        return "; ".join(said) or "none"


def only_artefacts(campaign: Campaign) -> bool:
    """Whether all runs of a campaign are of artefacts."""
    return bool(campaign.runs) and all(r.is_artefact for r in campaign.runs)


def artefact_finding(campaign: Campaign) -> ArtefactFinding:
    """Solve the campaign and separate part and machine. Raises as `solve_runs`."""
    solved = solve_runs(campaign.site, campaign.runs, instruments=campaign.doc.get("instruments"))
    joint, rank = solved.joint, pose_rank(solved.joint.data)
    waves = dict.fromkeys(f"a wave of {period_mm:.4g} mm along {'XYZ'[axis]}" for axis, period_mm in sure_periods(fine_of(joint)))
    scatter = joint.noise_mm["artefact"] / DEFAULT_SIGMA_MM["artefact"]
    return ArtefactFinding(campaign.name, solved, rank, () if rank is None else field_shares(joint, rank), tuple(waves), scatter)


def lines_of(found: ArtefactFinding) -> list[str]:
    """Return the finding line by line."""
    return [f"verdict: {found.verdict}", *artefact_lines(found.solved.joint), *(flag.line for flag in found.solved.flags)]


def answer_doc(found: ArtefactFinding) -> dict[str, Any]:
    """Return the finding as JSON object; amounts in mm at ``reach_mm``, standard uncertainties."""
    poses = None if found.rank is None else {"fields": found.rank.rank, "hidden": list(found.rank.hidden), "text": found.rank.text}
    return {
        "format": FORMAT,
        "campaign": found.campaign,
        "verdict": found.verdict,
        "fields": [asdict(s) for s in found.shares],
        "poses": poses,
        "waves": list(found.waves),
        "scatter": found.scatter,
        "flags": [flag.line for flag in found.solved.flags],
    }
