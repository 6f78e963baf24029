"""Pictures of what the readings tell."""

import re
import xml.etree.ElementTree as ET

import numpy as np

from abbe.service.rendering.model import MotionShare, Slice
from abbe.service.rendering.plots.bars import share_plot
from abbe.service.rendering.plots.maps import gain_map

ROWS = [MotionShare("EXX", 0.99, "observed"), MotionShare("EYX", 0.4, "weak"), MotionShare("EAX", 0.97, "not observable")]


def test_bars_are_as_long_as_the_share_and_only_observed_motions_are_called_fit_for_a_table():
    picture = share_plot(ROWS)
    ET.fromstring(picture)
    assert "1 of 3 may stand in a table of their own: EXX." in picture
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
