"""A table needs a certificate of every instrument that measured for it, a probed artefact included."""

from datetime import date

import pytest

from abbe.service.compensation.proposals import certified_until_s, until_s

LATE, EARLY = date(2099, 12, 31), date(2026, 1, 31)


@pytest.mark.parametrize(
    ("days", "instruments", "until"),
    [
        ({"artefact": LATE}, {"artefact"}, [LATE]),
        ({"ballbar": LATE, "laser": EARLY}, {"artefact"}, []),
        ({"ballbar": LATE}, {"artefact", "ballbar"}, []),
        ({"ballbar": LATE, "artefact": EARLY, "laser": LATE}, {"artefact", "ballbar"}, [EARLY, LATE]),
        ({}, {"ballbar"}, []),
    ],
)
def test_one_instrument_without_a_certificate_is_no_certificate(days: dict[str, date], instruments: set[str], until: list[date]) -> None:
    assert certified_until_s(days, instruments) == tuple(map(until_s, until))


def test_a_certificate_holds_to_the_end_of_its_last_day() -> None:
    assert until_s(LATE) - until_s(date(2099, 12, 30)) == pytest.approx(86_400.0)
