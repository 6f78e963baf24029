"""The colours of the reports' pictures on a screen: of the figures, not of the page, and dark where the reader has chosen dark."""

from __future__ import annotations

import re

_DARK = re.compile(r"@media screen and \(prefers-color-scheme:dark\)\{:root\{([^}]*)\}\}")


def themed(rules: str) -> str:
    """The rules of `abbe.service.rendering.palette.style_rules`, for figures of a page whose ``html`` says which scheme was chosen."""
    found = _DARK.search(rules)
    if found is None:
        raise ValueError("the palette has no dark colours in the form that is expected here")
    light = rules[: found.start()] + rules[found.end() :]
    first = light.replace(":root{color-scheme:light dark;", ":root figure{", 1)
    if first == light:
        raise ValueError("the palette does not begin as is expected here")
    asked = f"@media screen and (prefers-color-scheme:dark){{:root:not([data-theme=light]) figure{{{found[1]}}}}}"
    return f"{first}\n{asked}\n:root[data-theme=dark] figure{{{found[1]}}}\n"
