"""Errors of a parallel machine or its data: ValueErrors whose message names the pose and the leg."""
# ruff: noqa: N818 - the names say what is geometrically wrong

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SHOWN = 3


Fault = tuple[type["PoseError"], NDArray[np.bool_], str]


class KwonError(ValueError):
    """Base class of the errors of this package."""


class PoseError(KwonError):
    """A fault of one or more poses.

    Attributes
    ----------
    rows : tuple of int
        Rows of the poses, from 0.
    legs : tuple of int
        Leg (1, 2, 3) of each row; empty if the whole platform is concerned.
    """

    rows: tuple[int, ...] = ()
    legs: tuple[int, ...] = ()


class UnreachableLeg(PoseError):
    """C^2 < D: a leg is too short for the pose, and there is no inverse solution."""


class SerialSingularity(PoseError):
    """C^2 = D: a link is perpendicular to its rail, the two inverse solutions coincide, and the drive cannot move the link lengthwise."""


class NoForwardSolution(PoseError):
    """l^2 < (x_e + A)^2 + (y_e + B)^2: the three links do not meet for these commands."""


class CollinearSphereCentres(PoseError):
    """The determinant of the matrix in (4) is 0: the sphere centres lie on a line seen from above (vertical links, equal commands)."""


class ParallelSingularity(PoseError):
    """det[l1 l2 l3] = 0: the platform can move although the drives stand still."""


class LinksHorizontal(ParallelSingularity):
    """h = 0: all links lie in one horizontal plane with the sphere centres."""


class PlatformBelow(PoseError):
    """h < 0: the platform is below the sphere centres. `forward` never returns this other assembly of the links."""


class CollinearPoints(KwonError):
    """The points that should define a frame lie on a line or coincide: sin(theta) = 0 in (14), (16)."""


class SurfaceNotDetermined(KwonError):
    """The points do not determine the cubic response surface, or leave no residual to test the surface."""


class ExtrapolationRefused(KwonError):
    """A response surface is evaluated where nothing was measured."""


class NotSettled(KwonError):
    """An iteration did not converge: the points do not fit the nominal machine."""


def refuse(kind: type[PoseError], bad: NDArray[np.bool_], text: str) -> None:
    """Raise ``kind`` if any pose is bad.

    Parameters
    ----------
    kind : type
    bad : bool array, shape (n, 3) for pose x leg or (n,) for poses
    text : str
        Description of the fault for the user.
    """
    refuse_first((kind, bad, text))


def refuse_first(*faults: Fault) -> None:
    """Raise the first fault in the list that any pose has; its message also counts the poses that have only later faults.

    Parameters
    ----------
    faults : tuples of (kind, bad, text) as in `refuse`
    """
    for k, (kind, bad, text) in enumerate(faults):
        if bad.any():
            rest = [b.reshape(b.shape[0], -1).any(axis=1) for _, b, _ in faults[k + 1 :]]
            also = np.any(rest, axis=0) & ~bad.reshape(bad.shape[0], -1).any(axis=1) if rest else np.zeros(1, dtype=bool)
            raise _error(kind, bad, text, int(also.sum()))


def _error(kind: type[PoseError], bad: NDArray[np.bool_], text: str, others: int) -> PoseError:
    indices = np.argwhere(bad)
    names = [f"pose row {w[0]}, leg {w[1] + 1}" if w.size == 2 else f"pose row {w[0]}" for w in indices]
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    also = f"; and {others} more pose{'s' if others > 1 else ''} for other reasons" if others else ""
    error = kind(f"{'; '.join(names[:SHOWN])}{more}: {text}{also}")
    error.rows = tuple(int(w[0]) for w in indices)
    error.legs = tuple(int(w[1]) + 1 for w in indices if w.size == 2)
    return error
