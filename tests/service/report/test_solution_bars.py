"""The ranking of error contributions: nothing left of zero, figures rounded to their uncertainty and inside the picture."""

import re

from abbe.service.rendering.model import Contribution
from abbe.service.rendering.plots.bars import LABELS, WIDTH, contribution_bars

ROWS = [Contribution("EYY", 45.8512, 10.3), Contribution("EXX", 1.234, 4.0), Contribution("backlash X", 0.004, 0.18)]


def test_whiskers_of_sizes_end_at_zero():
    picture = contribution_bars(ROWS)
    across = [float(x) for x in re.findall(r'x[12]="([-0-9.]+)"', picture)]
    assert min(across) >= LABELS - 0.01
    assert max(across) <= WIDTH


def test_figures_are_rounded_to_their_uncertainty():
    picture = contribution_bars(ROWS)
    assert "46 ± 21 µm" in picture
    assert "45.85" not in picture
