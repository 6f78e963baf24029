"""Keep or go back, pass or fail: decisions about measured figures with their uncertainty."""

import numpy as np
import pytest

from models.verification import Figure
from service.workflows.verify import Figures, decide, judge, overall

NONE = np.zeros(0)


def figures(ppp: float, others: float = 5.0, helix: float | None = 5.0, u: float = 0.5) -> Figures:
    def figure(um: float) -> Figure:
        return Figure(um * 1e-3, u * 1e-3, NONE, NONE)

    diagonals = {"ppp": figure(ppp)} | {k: figure(others) for k in ("npp", "pnp", "ppn")}
    return Figures(diagonals, None if helix is None else figure(helix))


@pytest.mark.parametrize(
    ("before", "after", "keep", "why"),
    [
        (figures(40), figures(10), True, "40.0 → 10.0"),
        (figures(40), figures(39), False, "no improvement beyond its uncertainty"),
        (figures(40), figures(60), False, "no improvement"),
        (figures(20), figures(10, others=8.9), False, "diagonal npp got worse"),
        (figures(60, others=4), figures(10, others=9), True, "60.0 → 10.0"),  # 5 um is a small part of what the worst one was
        (figures(40), figures(10, helix=7.5), False, "helix got worse"),
        (figures(40, helix=2.0), figures(10, helix=6.9), False, "helix got worse"),
        (figures(40), figures(10, helix=None), False, "measured only once"),
    ],
)
def test_keep_only_what_is_better_and_nowhere_worse(before, after, keep, why):
    decision = decide(before, after)
    assert decision.keep is keep
    assert why in decision.text


@pytest.mark.parametrize(
    ("value", "u", "verdict"), [(8.9, 0.5, "pass"), (9.5, 0.5, "cannot tell"), (10.9, 0.5, "cannot tell"), (11.1, 0.5, "fail")]
)
def test_a_verdict_keeps_its_distance_from_the_limit(value, u, verdict):
    assert judge(value, u, 10.0) == verdict


def test_the_worst_verdict_counts_and_nothing_judged_is_no_pass():
    assert overall(["pass", "cannot tell"]) == "cannot tell"
    assert overall(["cannot tell", "fail"]) == "fail"
    assert overall([]) == "cannot tell"
