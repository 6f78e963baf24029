"""Bars: nothing left of zero, figures rounded to their uncertainty, lengths as the shares; the noise gain names unit and plane."""

import re
import xml.etree.ElementTree as ET

import numpy as np

from abbe.service.rendering.model import Contribution, MotionShare, Slice
from abbe.service.rendering.plots.bars import LABELS, WIDTH, contribution_bars, share_plot
from abbe.service.rendering.plots.maps import gain_map

RANKED = [Contribution("EYY", 45.8512, 10.3), Contribution("EXX", 1.234, 4.0), Contribution("backlash X", 0.004, 0.18)]


def test_whiskers_of_sizes_end_at_zero():
    picture = contribution_bars(RANKED)
    across = [float(x) for x in re.findall(r'x[12]="([-0-9.]+)"', picture)]
    assert min(across) >= LABELS - 0.01
    assert max(across) <= WIDTH


def test_figures_are_rounded_to_their_uncertainty():
    picture = contribution_bars(RANKED)
    assert "46 ± 21 µm" in picture
    assert "45.85" not in picture


SHARES = [MotionShare("EXX", 0.99, "observed"), MotionShare("EYX", 0.4, "weak"), MotionShare("EAX", 0.97, "not observable")]


def test_bars_are_as_long_as_the_share_and_only_observed_motions_are_called_fit_for_a_table():
    picture = share_plot(SHARES)
    ET.fromstring(picture)
    assert "1 of 3 can have a compensation table of their own: EXX." in picture
    width = {tip.split(":")[0]: float(w) for w, tip in re.findall(r'<rect [^>]*width="([\d.]+)"[^>]*><title>([^<]*)</title>', picture)}
    assert abs(width["EYX"] / width["EXX"] - 0.4 / 0.99) < 1e-3
    # what is not observable has an outline only, however large its share
    assert re.search(r'class="frame"><title>EAX: 97.0 % from readings, not observable', picture)


def test_no_motions_give_an_empty_picture():
    assert "0 of 0" in share_plot([])


def test_gain_map_names_unit_and_plane():
    x, y = np.linspace(0, 500, 12), np.linspace(0, 400, 10)
    values = 1.0 + (x[None, :] / 500.0) ** 2 + (y[:, None] / 400.0) ** 2
    picture = gain_map(Slice("X", "Y", "Z = 150 mm", x, y, values), key="gain")
    ET.fromstring(picture)
    assert "Noise gain, Z = 150 mm" in picture
    assert "from 1.00 to 3.00 µm per µm" in picture
    assert "X in mm" in picture
