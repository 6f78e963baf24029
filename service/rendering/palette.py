"""Colours of reports, distinguishable for colour-blind readers and legible on white, on black and on paper.

Plots never name a colour; they name a role (``c1``, ``seq3``, ``ink``), which the page's style sheet binds to a value for light and for
dark. The series colours descend from Okabe and Ito's set, darkened (light page) or lightened (dark page) until each has a contrast of 4.5.
"""

from __future__ import annotations

from collections.abc import Mapping

SERIES = 5
SEQUENCE = 5
BANDS = 8
"""Number of colours for signed values: half below zero, half above."""

LIGHT: Mapping[str, str] = {
    "page": "#ffffff",
    "panel": "#f6f7f9",
    "ink": "#1b1f24",
    "soft": "#57606a",
    "grid": "#d8dde3",
    "frame": "#767f8a",
    "band": "#e3eaf3",
    "c1": "#b34700",
    "c2": "#0062a3",
    "c3": "#00734f",
    "c4": "#9a3a72",
    "c5": "#6b5900",
    "seq1": "#4c8aa8",
    "seq2": "#3f6fae",
    "seq3": "#5a4aa5",
    "seq4": "#7d2a80",
    "seq5": "#7a0c32",
    "d1": "#123a6e",
    "d2": "#2d6cab",
    "d3": "#6ba2cf",
    "d4": "#b9d5ea",
    "d5": "#f7d3ae",
    "d6": "#eba25a",
    "d7": "#c96a1b",
    "d8": "#833a00",
}

DARK: Mapping[str, str] = {
    "page": "#14181d",
    "panel": "#1c2229",
    "ink": "#e8ebef",
    "soft": "#a9b2bd",
    "grid": "#333b45",
    "frame": "#7d8793",
    "band": "#26323f",
    "c1": "#f2994a",
    "c2": "#62b5e8",
    "c3": "#35c79a",
    "c4": "#e59bc5",
    "c5": "#e3cf57",
    "seq1": "#4f87a3",
    "seq2": "#6a9fd0",
    "seq3": "#a3b0ee",
    "seq4": "#e2b2e6",
    "seq5": "#ffd3a6",
    "d1": "#a9d6ff",
    "d2": "#66aee6",
    "d3": "#3a7bb0",
    "d4": "#254c6b",
    "d5": "#5e4227",
    "d6": "#a06430",
    "d7": "#dd9145",
    "d8": "#ffcf96",
}

_PLOT_RULES = """
svg text{font-family:inherit;font-size:12px;fill:var(--ink)}
svg .t-soft{fill:var(--soft)}
svg .t-head{font-size:13px;font-weight:600}
svg .t-small{font-size:11px;fill:var(--soft)}
svg .frame{fill:none;stroke:var(--frame);stroke-width:1}
svg .grid{fill:none;stroke:var(--grid);stroke-width:1}
svg .zero{fill:none;stroke:var(--frame);stroke-width:1}
svg .hidden-edge{fill:none;stroke:var(--frame);stroke-width:1;stroke-dasharray:3 4}
svg .band-edge{fill:none;stroke:var(--ink);stroke-width:1;stroke-dasharray:5 3}
svg .band{fill:var(--band);stroke:none}
svg .whisker{fill:none;stroke:var(--ink);stroke-width:1.4}
svg .key{fill:none;stroke:var(--ink);stroke-width:2}
svg .key-head{fill:var(--ink);stroke:none}
svg .dash{stroke-dasharray:7 4}
svg .dots{stroke-dasharray:1 4}
svg .ring-zero{fill:none;stroke:var(--frame);stroke-width:1.8}
svg .level{fill:none;stroke:var(--ink);stroke-width:.8}
svg .level-zero{fill:none;stroke:var(--ink);stroke-width:1.8}
svg .t-halo{paint-order:stroke;stroke:var(--page);stroke-width:3}
"""


def _role_rules() -> str:
    names = [f"c{i}" for i in range(1, SERIES + 1)] + [f"seq{i}" for i in range(1, SEQUENCE + 1)]
    lines = (f"svg .s-{name}{{fill:none;stroke:var(--{name});stroke-width:1.6;stroke-linejoin:round}}" for name in names)
    signed = [f"d{i}" for i in range(1, BANDS + 1)]
    rows = (*lines, *(f"svg .f-{name}{{fill:var(--{name});stroke:none}}" for name in (*names, *signed)))
    facet = "svg .facet{stroke:var(--page);stroke-width:.35;stroke-linejoin:round}"
    return "\n".join(rows) + f"\n{facet}\nsvg .thin{{stroke-width:1}}\n"


def _variables(values: Mapping[str, str]) -> str:
    return "".join(f"--{name}:{value};" for name, value in values.items())


def style_rules() -> str:
    """CSS with the colour of every role: light by default and in print, dark if the reader's system prefers it."""
    dark = f"@media screen and (prefers-color-scheme:dark){{:root{{{_variables(DARK)}}}}}"
    return f":root{{color-scheme:light dark;{_variables(LIGHT)}}}\n{dark}\n{_PLOT_RULES}{_role_rules()}"


def paper_rules(font: str) -> str:
    """CSS of a stand-alone picture: every role with its light colour, for programs without CSS variables."""
    rules = (_PLOT_RULES + _role_rules()).replace("font-family:inherit", f"font-family:'{font}'")
    for name, value in LIGHT.items():
        rules = rules.replace(f"var(--{name})", value)
    return rules


def contrast(first: str, second: str) -> float:
    """Contrast ratio of two ``#rrggbb`` colours as WCAG 2 defines it, 1 to 21."""
    lighter, darker = sorted((_luminance(first), _luminance(second)), reverse=True)
    return (lighter + 0.05) / (darker + 0.05)


def _luminance(colour: str) -> float:
    channels = (int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5))
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels)
    return float(0.2126 * red + 0.7152 * green + 0.0722 * blue)
