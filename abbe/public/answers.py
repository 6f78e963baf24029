"""What notebooks get: a value with its standard uncertainty, and a drawing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from abbe.service.files import write_page
from abbe.service.rendering.palette import style_rules


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture of one or more ``<svg>`` elements; a notebook displays it automatically."""

    svg: str

    def _repr_html_(self) -> str:
        return f'<div class="abbe-picture"><style>{style_rules()}.abbe-picture svg{{max-width:100%;height:auto}}</style>{self.svg}</div>'

    def save(self, target: str | Path) -> None:
        """Write the picture as an HTML page.

        Raises
        ------
        FileFormatError
            The file cannot be written.
        """
        write_page(f"<!doctype html><meta charset='utf-8'><title>Abbe</title>{self._repr_html_()}\n", Path(target))


class Estimate(NamedTuple):
    """A value and its standard uncertainty (GUM, k = 1), both in ``unit``.

    ``status``: "observed", "weak" or "not observable". Of a value that is "not observable", the readings determine only a
    combination with other values.
    """

    value: float
    u: float
    unit: str
    status: str

    def __str__(self) -> str:
        return f"{self.value:.3g} ± {2.0 * self.u:.2g} {self.unit} (k = 2, {self.status})"
