"""The nominal machine from its exchange object."""

import numpy as np
import pytest

from abbe.service.domain.machine import machine_from_doc

DOC = {"name": "m", "chain": "w-X-Y-b-Z-t", "stroke_mm": {"X": [0, 600], "Y": [0, 500], "Z": [0, 450]}}


def test_what_the_schema_lets_be_null_is_zero():
    machine = machine_from_doc(DOC | {"tool_mm": None, "pivots_mm": {"X": None, "Y": [1.0, 2.0, 3.0]}})
    assert (machine.tool_mm == 0).all()
    assert machine.pivots_mm == pytest.approx(np.array([[0, 0, 0], [1, 2, 3], [0, 0, 0]]))
    assert (machine_from_doc(DOC | {"pivots_mm": None}).pivots_mm == 0).all()
