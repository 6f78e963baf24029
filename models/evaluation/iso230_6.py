"""ISO 230-6: displacement along body and face diagonals. Each diagonal is evaluated like an axis by ISO 230-2; the result is the largest
figure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from abbe.models.evaluation.iso230_2 import Approaches, Positioning, ScaleBudget, Value, positioning

BODY = frozenset({"ppp", "npp", "pnp", "ppn"})
FACE = frozenset({"pp", "np"})


@dataclass(frozen=True, slots=True)
class Diagonals:
    """The diagonals of a volume (four) or of one plane (two).

    ``each``: evaluation of each diagonal, by name. ``E_d``, ``B_d``, ``M_d``: largest bidirectional systematic deviation, reversal, and
    range of the bidirectional means, each with the name of its diagonal; ``R_d``: largest repeatability, None without repeats. ``missing``:
    diagonals that the standard asks for and that were not measured; if there are any, the figures are lower bounds.
    """

    each: Mapping[str, Positioning]
    E_d: tuple[str, Value]
    B_d: tuple[str, Value]
    M_d: tuple[str, Value]
    R_d: tuple[str, Value] | None
    missing: tuple[str, ...]


def diagonals(
    readings: Mapping[str, Approaches], wanted: Iterable[str] = BODY, budgets: Mapping[str, ScaleBudget] | None = None
) -> Diagonals:
    """Evaluate the diagonals of a volume or a plane.

    Parameters
    ----------
    readings : mapping of str to Approaches
        Readings by name of the diagonal, a letter per axis: ``p`` grows along the diagonal, ``n`` falls. Positions are distances along it.
    wanted : iterable of str
        Names that the standard asks for: `BODY` or `FACE`.
    budgets : mapping of str to ScaleBudget, optional
        Budget of every diagonal; without it the uncertainties contain only the scatter of the cycles.

    Raises
    ------
    ValueError
        No diagonal, or one that is not in ``wanted``.
    """
    names = set(wanted)
    strange = sorted(set(readings) - names)
    if strange or not readings:
        raise ValueError(
            f"ISO 230-6: diagonal {strange[0]!r} is not one of {sorted(names)}" if strange else "ISO 230-6: no diagonal was given"
        )
    each = {name: positioning(readings[name], (budgets or {}).get(name)) for name in sorted(readings)}
    repeats = {name: p.R for name, p in each.items() if p.R is not None}
    return Diagonals(
        each,
        _largest({n: p.E for n, p in each.items()}),
        _largest({n: p.B for n, p in each.items()}),
        _largest({n: p.M for n, p in each.items()}),
        _largest(repeats) if repeats else None,
        tuple(sorted(names - set(readings))),
    )


def _largest(values: Mapping[str, Value]) -> tuple[str, Value]:
    name = max(sorted(values), key=lambda n: values[n].value_mm)
    return name, values[name]
