"""The printed table of the discovery: who names what, and for how much time and memory."""

from __future__ import annotations

from tests.experiments.bench.discovery_judge import ROWS

WORDS = {
    "discover": "ours, discover",
    "bic-forward": "(a) BIC forward, statsmodels",
    "lasso": "(b) lasso, scikit-learn",
    "bic-forward-names": "    BIC forward, names only",
    "lasso-names": "    lasso, names only",
}
SHORT = dict(zip(WORDS, ("ours", "(a) BIC", "(b) lasso", "(a) names only", "(b) names only"), strict=True))
GOAL_MEDIAN_S, GOAL_LONGEST_S, GOAL_MB = 10.0, 30.0, 500.0


def lines(found: dict) -> list[str]:
    """Naming, time, memory, notes."""
    who = found["contestants"]
    count, first = len(found["kinds"]), found["first_seed"]
    kinds = ", ".join(f"{found['kinds'].count(k)} {k}" for k in dict.fromkeys(found["kinds"]))
    out = ["", f"Naming what a simulation misses: campaigns {count} ({kinds}; seeds {first} to {first + count - 1})", ""]
    out.append(f"  {'':<39}" + "".join(f"{SHORT[k]:>16}" for k in WORDS))
    for row, words in ROWS.items():
        out.append(f"  {words:<39}" + "".join(f"{_share(who[k]['counts'][row]):>16}" for k in WORDS))
    heads = f"{'median s':>10}{'longest s':>11}{'columns s':>11}{'clock s':>9}{'beyond MB':>11}{'process MB':>12}"
    out += ["", f"  {'processor time per campaign, one core':<39}{heads}"]
    for k, words in WORDS.items():
        c = who[k]["costs"]
        times = f"{c['median_s']:10.2f}{c['longest_s']:11.2f}{_s(c['columns_s'])}{c['clock_s']:9.2f}"
        out.append(f"  {words:<39}{times}{_mb(c['beyond_mb']):>11}{_mb(c['process_peak_mb']):>12}")
    return [*out, _goals(who["discover"]["costs"]), _long(found["long"]), *NOTES]


def _long(run: dict) -> str:
    """The longest campaign whose readings are searched one by one."""
    time, peak = run["cpu_s"], run["process_peak_mb"]
    memory = "memory not measured" if peak is None else f"process {peak:.0f} MB{_verdict(peak <= GOAL_MB)}"
    return f"  discover with {run['readings']} ball-bar readings: {time:.1f} s{_verdict(time <= GOAL_LONGEST_S)}, {memory}"


def _goals(c: dict) -> str:
    parts = [
        f"median {GOAL_MEDIAN_S:.0f} s{_verdict(c['median_s'] <= GOAL_MEDIAN_S)}",
        f"longest {GOAL_LONGEST_S:.0f} s{_verdict(c['longest_s'] <= GOAL_LONGEST_S)}",
    ]
    peak = c["process_peak_mb"]
    parts.append("memory not measured" if peak is None else f"process {GOAL_MB:.0f} MB{_verdict(peak <= GOAL_MB)}")
    return f"  goals of discover: {', '.join(parts)}"


NOTES = [
    "",
    "All choose from the same columns: every effect of the catalogue at every key and start, and structures without a name, whitened,",
    "with all that the present simulation may still change taken out. (a) puts in what lowers BIC most until nothing does, ten at most.",
    "(b) is the point of the LARS path with the lowest BIC. Starts of one label are one name. Names only: without the structures that have",
    "no name. Columns: what of the time makes them (middle). discover makes them too, refines, re-examines, looks at scatter, states",
    "rivals and predicts all runs, which (a) and (b) do not. Beyond MB: largest rise of resident memory during a call. One campaign more",
    "or less is no difference between methods: for shares worth the name, python -m tests.experiments.campaigns.discovery_suite.",
]


def _share(count: list[int]) -> str:
    hits, of = count
    return f"{hits} of {of}"


def _s(value: float | None) -> str:
    return f"{'-':>11}" if value is None else f"{value:11.2f}"


def _mb(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"


def _verdict(met: bool) -> str:
    return ": met" if met else ": NOT MET"
