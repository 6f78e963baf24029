"""A figure with its U and its limit as a bar, as SVG. No script, no inline style (CSP)."""

from __future__ import annotations

from html import escape

WIDTH, HEIGHT = 560.0, 44.0
LEFT, RIGHT, MIDDLE = 2.0, 14.0, 22.0


def gauge_svg(title: str, value: float, expanded: float | None, limit: float | None, verdict: str) -> str:
    """The bar, from zero to beyond limit and value. All numbers in one unit; ``expanded``: U, None if unknown; ``title``: its text."""
    u = expanded or 0.0
    top = max(1.15 * (limit or 0.0), 1.1 * (abs(value) + u), 1e-12)

    def x(at: float) -> float:
        return LEFT + min(max(at, 0.0), top) / top * (WIDTH - LEFT - RIGHT)

    kind = verdict.replace(" ", "-")
    size = abs(value)
    body = [f'<rect class="track" x="{LEFT:g}" y="{MIDDLE - 7:g}" width="{WIDTH - LEFT - RIGHT:g}" height="14"/>']
    wide = max(x(size + u) - x(size - u), 1.0)
    body.append(f'<rect class="band" x="{x(size - u):.1f}" y="{MIDDLE - 7:g}" width="{wide:.1f}" height="14"/>')
    if limit is not None:
        body.append(f'<path class="limit" d="M{x(limit):.1f} 2V{HEIGHT - 2:g}"/>')
    body.append(f'<path class="mark {kind}" d="M{x(size):.1f} {MIDDLE - 12:g}l8 12l-8 12l-8 -12z"/>')
    label = escape(title, quote=True)
    return f'<svg class="gauge" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{label}">{"".join(body)}</svg>'
