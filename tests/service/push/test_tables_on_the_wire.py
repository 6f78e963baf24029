"""Tables from arrays to the controller's bytes: axis order, sign and unit, against bytes taken apart by hand from docs/protocols/cnc.md."""

import struct

import numpy as np
import pytest

from abbe.drivers.tables import encode
from abbe.models.compensation.tables import NineTables, quantise
from abbe.service.errors import TableRefused
from abbe.service.push.execute import semantic_digest_of_image, semantic_digest_of_tables
from abbe.service.push.validate import PushLimits
from abbe.service.tables.nine_tables import added, check_test_step, table_image


def tables(scale: float = 1.0) -> NineTables:
    """Every one of the nine curves differs from every other, in size and in sign."""
    positions = (np.linspace(0, 600, 4), np.linspace(0, 500, 3), np.linspace(-50, 400, 5))
    curves = []
    for a in range(3):
        ramp = np.arange(positions[a].size)[:, None]
        curves.append(scale * ramp * np.array([1e-3, -2e-3, 3e-3]) * (a + 1))
    none = tuple(np.zeros_like(c) for c in curves)
    return NineTables(positions, tuple(curves), none)


def test_every_curve_stands_where_the_protocol_says_with_its_own_sign():
    image = encode(table_image(tables(), 100, 7))
    words = struct.unpack(f">{len(image) // 2}h", image)
    assert struct.unpack(">H", image[:2])[0] == 0xABBE
    assert words[2] == 1
    assert words[8:11] == (4, 3, 5)
    at = 24
    for a, n in enumerate((4, 3, 5)):
        for unit in (10, -20, 30):  # 1, -2, 3 um a step in 0.1 um units: output X, Y, Z
            assert words[at : at + n] == tuple(unit * (a + 1) * k for k in range(n))
            at += n
    assert at == len(words) == words[3]
    start_z = struct.unpack(">i", image[2 * 16 : 2 * 18])[0]
    assert start_z == -5_000_000  # -50 mm in 10 nm


@pytest.mark.parametrize("wrong", ["sign", "axis in", "axis out", "unit"])
def test_an_encoder_that_lies_is_caught_by_the_independent_decoder(wrong):
    want = tables()
    curves, positions = [c.copy() for c in want.correction_mm], want.position_mm
    if wrong == "sign":
        curves = [-c for c in curves]
    elif wrong == "axis out":
        curves = [c[:, [1, 0, 2]] for c in curves]
    elif wrong == "unit":
        curves = [c * 10 for c in curves]
    elif wrong == "axis in":
        curves, positions = [curves[1], curves[0], curves[2]], (positions[1], positions[0], positions[2])
    lied = NineTables(positions, tuple(curves), want.u_mm)
    assert semantic_digest_of_image(encode(table_image(lied, 100, 7))) != semantic_digest_of_tables(want)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_entry_goes_to_the_nearest_unit_whichever_side_it_is_on(sign):
    positions = tuple(np.linspace(0.0, 500.0, 6) for _ in range(3))
    units = sign * np.array([0.0, 1.4, 1.6, 2.0, 7.49, 7.51])
    curve = np.repeat(1e-4 * units[:, None], 3, axis=1)
    found = quantise(NineTables(positions, (curve, curve, curve), (curve, curve, curve)), 1e-4)
    for rounded in found.correction_mm:
        assert rounded / 1e-4 == pytest.approx(np.repeat(sign * np.array([0.0, 1.0, 2.0, 2.0, 7.0, 8.0])[:, None], 3, axis=1))


def test_an_honest_encoder_means_what_was_computed_once_it_is_quantised():
    want = quantise(tables(1.2345), 1e-4)
    assert semantic_digest_of_image(encode(table_image(want, 100, 7))) == semantic_digest_of_tables(want)


@pytest.mark.parametrize(
    ("limits", "what"),
    [
        (PushLimits(value_mm=0.01), "VALUE: .* table_value_um"),
        (PushLimits(change_mm=0.01), "CHANGE: .* table_change_um"),
        (PushLimits(step_mm=0.004), "STEP: .* table_step_um"),
    ],
)
def test_limits_refuse_and_say_which_key_to_look_at(limits, what):
    check_test_step(tables(), None, PushLimits())
    with pytest.raises(TableRefused, match=what) as caught:
        check_test_step(tables(), None, limits)
    assert "nothing was written" in caught.value.remedy


def test_change_is_measured_against_the_active_table():
    limits = PushLimits(change_mm=0.005)
    check_test_step(tables(1.1), tables(1.0), limits)
    with pytest.raises(TableRefused, match="CHANGE"):
        check_test_step(tables(-1.0), tables(1.0), limits)


def test_a_table_with_nan_or_off_zero_is_refused():
    bad = tables()
    bad.correction_mm[1][1, 2] = np.nan
    with pytest.raises(TableRefused, match="table of Z over Y: holds values that are not numbers"):
        check_test_step(bad, None, PushLimits())
    shifted = tables()
    shifted.correction_mm[0][:, 0] += 0.01
    with pytest.raises(TableRefused, match="not zero at its reference"):
        check_test_step(shifted, None, PushLimits())


def test_a_change_adds_to_what_is_active_on_its_own_grid():
    active = NineTables(
        (np.array([0.0, 600.0]), np.array([0.0, 500.0]), np.array([-50.0, 400.0])), (np.ones((2, 3)),) * 3, (np.ones((2, 3)),) * 3
    )
    active.correction_mm[0][:] = [[0.0, 0.0, 0.0], [6e-3, 0.0, -6e-3]]
    total = added(active, tables())
    for got, want in zip(total.position_mm, tables().position_mm, strict=True):
        assert (got == want).all()
    assert total.correction_mm[0][:, 0] == pytest.approx([0.0, 3e-3, 6e-3, 9e-3])
    assert total.correction_mm[0][:, 2] == pytest.approx([0.0, 1e-3, 2e-3, 3e-3])
    assert added(None, tables()).correction_mm[2] == pytest.approx(tables().correction_mm[2])


def test_the_three_tables_of_an_axis_are_limited_together():
    check_test_step(tables(), None, PushLimits(value_mm=0.06))
    with pytest.raises(TableRefused, match="together"):
        check_test_step(tables(), None, PushLimits(value_mm=0.05))  # each alone stays below 0.04
