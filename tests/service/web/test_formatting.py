"""What a person at the page reads names no command of the command line."""

from __future__ import annotations

import pytest

from abbe.service.web.formatting import without_commands


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("`abbe measure -m MACHINE.toml --resume CAMPAIGN` resumes it", ""),
        ("runs of campaign 'c 10:18:02' are kept; `abbe measure --resume 'c'` resumes", "runs of campaign 'c 10:18:02' are kept"),
        ("this campaign has no stored solution (abbe solve)", "this campaign has no stored solution"),
        ("look at 3.5 µm. Run abbe comp commission. Then go on.", "look at 3.5 µm. Then go on."),
        ("誰が書いたか調べる。正しければ承認してもらう (abbe accept-table)", "誰が書いたか調べる。正しければ承認してもらう"),
        ("Report by abbe 0.1.0; abbe@host", "Report by abbe 0.1.0; abbe@host"),
    ],
)  # fmt: skip
def test_parts_with_a_command_are_left_out(text: str, told: str) -> None:
    assert without_commands(text) == told


@pytest.mark.parametrize(
    "text",
    [
        "no proposal: campaign 'c' has only points of artefacts, and nothing is searched in those - `abbe discover c` does",
        "correct the control, then run abbe comp commission again; nothing was written",
        "do not machine; restore the old table at the controller, or vouch for the new one with abbe accept-table",
        "if this is that machine and its table is right: abbe accept-table; nothing was written",
        "the next abbe command rolls the table back before anything else",
    ],
)
def test_a_part_that_says_more_than_a_command_stays(text: str) -> None:
    """It may hold the cause, or what a person has to do first."""
    assert without_commands(text) == text
