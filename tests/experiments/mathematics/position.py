"""Where the machine was when a sample was taken: in the controller's stream of positions, or along the planned path between its stamps."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2


def position_in_stream(t_s: F1, stream_s: F1, stream_mm: F2, *, longest_gap_s: float = np.inf) -> F2:
    """Positions at given times, straight between the stream's; NaN outside of it and inside gaps longer than ``longest_gap_s``.

    Parameters
    ----------
    t_s : array, shape (n,)
    stream_s : array, shape (m,)
        Rising; in the clock of ``t_s``.
    stream_mm : array, shape (m, 3)

    Returns
    -------
    array, shape (n, 3), mm.

    Raises
    ------
    ValueError
        Fewer than two positions, or their times do not rise.
    """
    if stream_s.size < 2 or stream_mm.shape != (stream_s.size, 3) or (np.diff(stream_s) <= 0.0).any():
        raise ValueError("stream: two positions or more, with times that rise")
    out = np.stack([np.interp(t_s, stream_s, stream_mm[:, a]) for a in range(3)], axis=1)
    after = np.clip(np.searchsorted(stream_s, t_s, side="right"), 1, stream_s.size - 1)
    unknown = (t_s < stream_s[0]) | (t_s > stream_s[-1]) | (np.diff(stream_s)[after - 1] > longest_gap_s)
    out[unknown] = np.nan
    return out


def position_on_path(t_s: F1, path_mm: F2, start_s: float, end_s: float) -> F2:
    """Positions along a polyline that was run at constant speed from ``start_s`` to ``end_s``, (n, 3) mm; NaN before and after it."""
    steps = np.linalg.norm(np.diff(path_mm, axis=0), axis=1)
    if not end_s > start_s or not steps.sum() > 0.0:
        raise ValueError("path: it must have a length and end after it began")
    corners = path_mm[np.concatenate(([True], steps > 0.0))]
    arc = np.concatenate(([0.0], np.cumsum(steps[steps > 0.0])))
    share = (np.asarray(t_s, dtype=np.float64) - start_s) / (end_s - start_s)
    out = np.stack([np.interp(share * arc[-1], arc, corners[:, a]) for a in range(3)], axis=1)
    out[(share < 0.0) | (share > 1.0)] = np.nan
    return out
