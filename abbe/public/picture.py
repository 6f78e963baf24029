"""A drawing for notebooks and files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from abbe.service.rendering.page_file import write_page
from abbe.service.rendering.palette import style_rules


@dataclass(frozen=True, slots=True)
class Picture:
    """One or more ``<svg>`` elements; a notebook displays it automatically."""

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
