"""The ``truth`` command: figures and drawn parameters of a scenario's machine under a compensation image."""

import struct

from abbe.simulators.cnc import bank
from abbe.simulators.hidden.live import live_of
from abbe.simulators.scenario import Scenario, ScenarioError
from abbe.simulators.truth.draws import describe, draw_machine
from abbe.simulators.truth.figures import no_correction, report
from abbe.simulators.truth.machine import Geometry, Machine


def truth(scenario: Scenario, image: bytes | None, nodes: int, *, arrows: bool = False) -> dict[str, object]:
    """Evaluate a machine without any wire; ``image`` is a compensation image as big-endian bytes, None for no correction."""
    draws = draw_machine(scenario)
    machine = Machine(Geometry(scenario.machine), draws)
    secret = live_of(scenario.hidden, machine.geometry.low_mm, machine.geometry.high_mm)
    hidden: dict[str, object] = {} if secret is None else {"hidden": secret.describe()}
    correction = no_correction if image is None else _correction(image)
    return {**report(machine, correction, nodes, arrows=arrows), **describe(draws), **hidden}


def _correction(image: bytes) -> bank.Correction:
    if len(image) % 2:
        raise ScenarioError("bank image: an odd number of bytes")
    try:
        return bank.parse(list(struct.unpack(f">{len(image) // 2}H", image)))[1]
    except bank.ImageError as exc:
        raise ScenarioError(f"bank image: {exc}") from exc
