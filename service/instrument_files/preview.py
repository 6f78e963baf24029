"""What an import would store, as text for a person who decides."""

from __future__ import annotations

import numpy as np

from abbe.service.domain.imported_file import SourceFile
from abbe.service.instrument_files.content import AxisReadings, Content
from abbe.service.rendering.numbers import plain

UM = 1e3
URAD = 1e6


def preview_rows(content: Content, test: AxisReadings | None, origin: SourceFile) -> list[tuple[str, str]]:
    """Names and values of one file: what it is, what it states, its readings, what was not read and what is unknown."""
    out = [("file", content.name), ("format", content.form), ("machine", content.machine or "not stated")]
    if test is not None:
        out += _test_rows(test)
    if content.trace is not None:
        trace = content.trace
        out.append(("trace", f"{trace.samples.size} samples, {plain(trace.rate_hz)} a second"))
    out += [(f"{one.group} {one.symbol}".strip(), f"{one.value:g} {one.unit} ({one.name})") for one in content.stated]
    out += [(f"said: {name}", value) for name, value in content.said.items()]
    return out + [("note", note) for note in content.notes] + [("unknown", text) for text in origin.unknown]


def _test_rows(test: AxisReadings) -> list[tuple[str, str]]:
    factor, unit = (UM, "µm") if test.quantity == "length" else (URAD, "µrad")
    targets, count = np.unique(test.position_mm, return_counts=True)
    ways = {1.0: "+", -1.0: "-", 0.0: "means of both directions"}
    moving = ", ".join(ways[way] for way in sorted(set(test.direction.tolist()), reverse=True))
    few, many = int(count.min()), int(count.max())
    visits = f"{few} times" if few == many else f"{few} to {many} times"
    first = ", ".join(
        f"{p:g} mm {ways.get(d, '')} {v * factor:g} {unit}"
        for p, d, v in zip(test.position_mm[:3], test.direction[:3], test.deviation[:3], strict=True)
    )
    return [
        ("axis", test.axis),
        ("targets", f"{targets.size} from {targets[0]:g} to {targets[-1]:g} mm, each read {visits}, moving {moving}"),
        ("readings", f"{test.deviation.size} from {test.deviation.min() * factor:g} to {test.deviation.max() * factor:g} {unit}"),
        ("resolution", f"{test.resolution * factor:g} {unit}, by the printed decimals"),
        ("first readings", first),
    ]
