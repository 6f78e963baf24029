"""Writes docs/reference/device-file.md from the schema: ``python -m tests.project.device_file_page`` (``--check``: is it current?)."""

from __future__ import annotations

import sys
from pathlib import Path

from abbe.drivers.device_file import BUILTIN, FORMAT, NEEDED, QUANTITIES, DeviceFile
from tests.project.machine_file_page import sections
from tests.written_page import run

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "device-file.md"
_HEAD = f"""# Device file

`python -m tests.project.device_file_page` writes this page from the schema (`drivers/device_file.py`); a test checks that it is current.
A device file (TOML, `format = "{FORMAT}"`) describes the protocol of one kind of device. The URL holds the address and names the file:
`modbus+tcp://192.168.0.20:502?unit=1&device=my-meter.toml` (beside the machine file), or a shipped one without `.toml`.
An unknown key is an error. [The how-to](../how-to/own-device.md) writes one.
"""


def page() -> str:
    """The whole page."""
    schema = DeviceFile.model_json_schema()
    shipped = "".join(f"| `{path.stem}` | {_title(path)} |\n" for path in sorted(BUILTIN.glob("*.toml")))
    needed = "; ".join(f"`{kind}` needs {', '.join(names)}" for kind, names in NEEDED.items())
    units = "".join(f"| `{name}` | {', '.join(units)} |\n" for name, units in QUANTITIES.items())
    return (
        f"{_HEAD}\n## Shipped files\n\n| name | device |\n|---|---|\n{shipped}"
        + "".join(sections(schema, schema, "", schema["description"]))
        + f"\n## Values that a job can use\n\nA file of kind {needed}. Values of other names are for flags.\n\n"
        + f"| value | units |\n|---|---|\n{units}"
    )


def _title(path: Path) -> str:
    return next(line for line in path.read_text().splitlines() if line.startswith("# ")).removeprefix("# ")


if __name__ == "__main__":
    sys.exit(run(PAGE, page, "tests.project.device_file_page", __doc__))
