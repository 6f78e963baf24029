"""Errors of a parallel machine or its data. All are ValueErrors whose one line names the pose and the leg."""
# ruff: noqa: N818 - the names say what is geometrically wrong, as math.md 6 lists it

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SHOWN = 3


Fault = tuple[type["PoseError"], NDArray[np.bool_], str]


class KwonError(ValueError):
    """Base of this package's errors."""


class PoseError(KwonError):
    """An error of single poses.

    Attributes
    ----------
    rows : tuple of int
        Pose rows concerned, from 0.
    legs : tuple of int
        Leg numbers concerned (1, 2, 3), row by row; empty where the whole platform is meant.
    """

    rows: tuple[int, ...] = ()
    legs: tuple[int, ...] = ()


class UnreachableLeg(PoseError):
    """C^2 < D: a leg is too short for the pose, the inverse solution does not exist (math.md 6)."""


class SerialSingularity(PoseError):
    """C^2 = D: the link stands perpendicular to its rail; the two inverse solutions meet and the leg cannot push along its link."""


class NoForwardSolution(PoseError):
    """l^2 < (x_e + A)^2 + (y_e + B)^2: the three links do not meet for these commands."""


class CollinearSphereCentres(PoseError):
    """det of the 2 x 2 matrix of (4) is 0: the sphere centres lie on a line seen from above (for equal commands: vertical links)."""


class ParallelSingularity(PoseError):
    """det[l1 l2 l3] = 0: the platform can move although the drives stand still."""


class LinksHorizontal(ParallelSingularity):
    """h = 0: all links lie in one horizontal plane with the sphere centres."""


class PlatformBelow(PoseError):
    """h < 0: the platform is below the sphere centres, the other assembly of the same links, which `forward` never returns."""


class CollinearPoints(KwonError):
    """Points that are to define a frame lie on a line (or coincide): sin(theta) = 0 in (14), (16)."""


class SurfaceNotDetermined(KwonError):
    """The points do not determine the cubic response surface, or leave no residual to judge it by."""


class ExtrapolationRefused(KwonError):
    """A response surface was asked for a height or a place at which nothing was measured."""


class NotSettled(KwonError):
    """An iteration did not converge: the points do not fit the nominal machine."""


def refuse(kind: type[PoseError], bad: NDArray[np.bool_], text: str) -> None:
    """Raise ``kind`` when any pose is bad.

    Parameters
    ----------
    kind : type
    bad : bool array, shape (n, 3) for pose x leg or (n,) for poses
    text : str
        What is wrong, in the words of the user.
    """
    refuse_first((kind, bad, text))


def refuse_first(*faults: Fault) -> None:
    """Raise the first kind that any pose shows, and count the poses that only the others concern.

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
