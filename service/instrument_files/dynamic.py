"""Renishaw .rtx: samples of a displacement at a constant rate; a header of text, then binary data.

The format is known from one public reader and one real header.

The file does not state the unit of the samples, nor where the axis was at each of them: both are asked.
"""

from __future__ import annotations

import numpy as np

from abbe.service.errors import FileFormatError
from abbe.service.formats.files import TextFile
from abbe.service.instrument_files.content import Content, Trace, axis_of, digest, text_file

HEAD, DATA, END = b"HEADER::\r\n", b"Data:\r\n", b"EOF::\r\n"
SAMPLE = np.dtype("<f8")
MOST = 1e9
"""Largest accepted number of samples, and of samples per second; no file has more."""
LARGEST = 1e12
"""Largest accepted size of a sample, in the file's own unit."""


def read_rtx(name: str, data: bytes) -> Content:
    """Read a .rtx.

    Raises
    ------
    FileFormatError
        The file is incomplete or contradicts itself; the message has the line, or the sample.
    """
    head, found, samples = data.partition(b"\r\n" + DATA)
    if not data.startswith(HEAD) or not found:
        raise FileFormatError(f"{name}:1: not an .rtx file: it does not begin with HEADER:: or has no Data:", "export the file again")
    file = text_file(name, head)
    facts, lines = _facts(file)
    count, rate = int(float(facts["sample no"])), float(facts["actual sample rate"])
    at = max(lines.values()) + 2  # the line behind Data:
    if len(samples) != count * SAMPLE.itemsize + len(END) or not samples.endswith(END):
        what = f"{len(samples)} bytes follow, but {count} samples and EOF:: have {count * SAMPLE.itemsize + len(END)}"
        raise file.wrong(at, f"{what}: the file is cut off, or damaged", "export the file again")
    values = np.frombuffer(samples, SAMPLE, count).astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(values) | (np.abs(values) > LARGEST))
    if bad.size:
        raise file.wrong(
            at, f"sample {bad[0] + 1} is {float(values[bad[0]])!r}, expected {-LARGEST:g} to {LARGEST:g}", "export the file again"
        )
    return Content(
        name=name,
        form="Renishaw .rtx",
        sha256=digest(data),
        machine=facts.get("machine", ""),
        said={key.capitalize(): value for key, value in facts.items() if value},
        trace=Trace(axis=axis_of(facts.get("axis", "")), samples=values, rate_hz=rate),
    )


def _facts(file: TextFile) -> tuple[dict[str, str], dict[str, int]]:
    facts, lines, line = dict[str, str](), dict[str, int](), 1
    for line, text in file.lines():
        if not text.strip() or text.endswith("::"):
            continue
        key, colon, value = text.partition(":")
        name = " ".join(key.split()).lower()
        if not colon or name in lines:
            raise file.wrong(line, f"{text[:40]!r} is not 'Key: value', or is repeated")
        facts[name], lines[name] = value.strip(), line
    for name, least in (("sample no", 2.0), ("actual sample rate", 1e-9)):
        if name not in facts:
            raise file.wrong(line, f"{name!r} is missing")
        number = file.number(lines[name], facts[name], name.capitalize())
        if not least <= number <= MOST or (name == "sample no" and number % 1.0):
            raise file.wrong(lines[name], f"{name.capitalize()} is {facts[name]}, which is impossible")
    return facts, lines
