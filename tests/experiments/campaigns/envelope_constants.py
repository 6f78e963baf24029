"""How far the line under a cloud of delays lies off: the constants of models/alignment/clock.py, counted on clouds with known edges.

python -m tests.experiments.campaigns.envelope_constants [--clouds 60000] [--lowest 100]
"""

from __future__ import annotations

import argparse
import sys
from itertools import pairwise

import numpy as np

from abbe.models.alignment.clock import LOWEST, _edge, _edge_of_delays

EDGES = (0.42, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.35, 1.5, 1.75, 2.0, 2.5, 3.0, 4.5)


def cloud(rng: np.random.Generator, lowest: int) -> tuple[float, float, float]:
    """Estimated exponent, error in the middle and rise from end to end of the line under one cloud, over the 24th least delay."""
    power = np.exp(rng.uniform(np.log(0.6), np.log(4.5)))
    n = int(rng.choice([4, 8, 20])) * lowest
    delay = rng.uniform(0.0, 1.0, n) ** (1.0 / power)
    keep = np.argpartition(delay, 3 * lowest)[: 3 * lowest]  # the others touch neither the line nor the least delays
    x, y = rng.uniform(-0.5, 0.5, keep.size), delay[keep]
    order = np.argsort(x)
    x, y = x[order], y[order]
    i, k = _edge(x, y)
    slope = (y[k] - y[i]) / (x[k] - x[i])
    level = y[i] - slope * x[i]
    above = y - level - slope * x
    above[[i, k]] = np.inf
    scale, shape = _edge_of_delays(np.partition(above, lowest - 1)[:lowest])
    return shape, level / scale, slope / scale


def main() -> int:
    """Print one row of constants for each interval of the exponent."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clouds", type=int, default=60000, help="how many clouds to draw (about 2000 a second)")
    parser.add_argument("--lowest", type=int, default=100, help="from how many least delays the exponent is estimated")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    rows = []
    for n in range(options.clouds):
        rows.append(cloud(rng, options.lowest))
        if n % 5000 == 4999:
            sys.stderr.write(f"{n + 1} of {options.clouds} clouds\n")
    shape, level, slope = np.array(rows).T
    sys.stdout.write(f"# scale: the {LOWEST}th least delay\n# exponent  bias  half_95  tilt_95  clouds\n")
    bins = [(shape >= low) & (shape < high) for low, high in pairwise(EDGES)]
    bins = [here for here in bins if here.sum() >= 100]
    middles, biases = [shape[here].mean() for here in bins], [level[here].mean() for here in bins]
    level = level - np.interp(shape, middles, biases)  # as it is used: the bias is taken off between the rows as well
    for here, middle, bias in zip(bins, middles, biases, strict=True):
        half, tilt = np.quantile(np.abs(level[here]), 0.9545), np.quantile(np.abs(slope[here]), 0.9545)
        place = rng.uniform(-0.5, 0.5, here.sum())  # of a sample between the ends: there both count, and 95.45 % are wanted
        share = float(np.quantile(np.abs(level[here] + slope[here] * place) / np.hypot(half, tilt * place), 0.9545))
        sys.stdout.write(f"{middle:.3f} {bias:.4f} {share * half:.4f} {share * tilt:.4f} {here.sum()}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
