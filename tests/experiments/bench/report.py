"""The printed table: times, ratios against goals, memory, and how far from the floor that memory sets."""

from __future__ import annotations

from tests.experiments.bench import capture, discovery_report, history, parsers, reanalysis, start, trials_report
from tests.experiments.bench.contestants import EXTRA, FLOORS, OURS, PEERS
from tests.experiments.bench.facts import LIBRARIES

GOALS = {"numpy": {"htm": 25, "sympy": 12, "pytransform3d": 12}, "compiled": {"htm": 200, "sympy": 100, "pytransform3d": 100}}
GOALS["compiled-1"] = GOALS["compiled"]
GOALS["product"] = {"htm": 1, "sympy": 1, "pytransform3d": 1}
GRID_FLOORS = 3.0
"""Times the copy of 24 MB that the product may take for the grid."""
MEMORY_MB = 200
CASE_WORDS = {"scattered": "1,000,000 scattered points", "grid": "grid of 100 x 100 x 100 points"}
WORDS = {
    "htm": "(a) HTM matmul, numpy",
    "sympy": "(b) sympy lambdify, cse",
    "pytransform3d": "(c) pytransform3d batch",
    "sympy-open": "    sympy, axes broadcast",
    "sympy-even": "    sympy, even look-up",
    "sympy-g-even": "    sympy, rule G, even look-up",
    "htm-small": "    HTM, small-angle matrices",
    "htm-small-even": "    HTM, small angles, even look-up",
    "copy": "floor: copy 24 to 24 MB, 1 core",
    "copy-all": "floor: the same, all cores",
    "fill": "floor: write 24 MB, 1 core",
    "compiled-1": "even tables, compiled, 1 thread",
    "product": "the product",
    "numpy": "even tables, numpy",
}

SHORT = {"product": "product", "numpy": "numpy", "compiled": "compiled, all cores", "compiled-1": "compiled, 1 thread"}


def text(found: dict) -> str:
    """Everything for people."""
    f = found["facts"]
    words = {**WORDS, "compiled": f"even tables, compiled, {f['threads']} threads"}
    busy = "" if f["load"] is None else f", load {f['load']:.1f} at the start"
    lines = [
        "Deviation of a machine with 21 errors, tables of 51 nodes, float64; trials and propagation of uncertainties",
        f"{f['processor']}, {f['cores']} cores{busy}; {f['system']}, Python {f['python']}",
        ", ".join(f"{k} {f[k]}" for k in LIBRARIES),
    ]
    for name, case in found["cases"].items():
        lines += ["", *_times(name, case, words), *_plainly(name, case), "", *_goals(name, case, words), "", *_results(case, words)]
    if found["cases"]:
        lines += MAP_NOTES
    if found["trials"]:
        lines += trials_report.lines(found["trials"])
    if found["discovery"]:
        lines += discovery_report.lines(found["discovery"])
    if found["capture"]:
        lines += capture.lines(found["capture"])
    if found["parsers"]:
        lines += parsers.lines(found["parsers"])
    if found["history"]:
        lines += history.lines(found["history"])
    if found["reanalysis"]:
        lines += reanalysis.lines(found["reanalysis"])
    if found["start"]:
        lines += start.lines(found["start"])
    return "\n".join([*lines, "", "Times never fail this run, differing results do."])


MAP_NOTES = [
    "",
    "Ratios are of best times. Beyond MB: largest rise of resident memory during one call, result excluded, libraries loaded before.",
    "Process MB: everything, with interpreter, libraries, points and result. Look-up: share of the best time that table values take.",
    "Peers (a) to (c) search the tables by numpy.interp, on the grid at its 3 x 100 positions only; ours know that the nodes are even",
    "and prepare the straight pieces before the clock starts. The rows below (c) get more help, and have no goal.",
]


def _times(name: str, case: dict, words: dict) -> list[str]:
    who, floor = case["contestants"], _floor(case)
    out = [f"{CASE_WORDS[name]:<39}{'best ms':>9}{'median':>9}{'x floor':>9}{'beyond MB':>11}{'process MB':>12}{'look-up':>9}"]
    for k in [*OURS[name], *PEERS, *EXTRA[name], *FLOORS[name]]:
        w = who[k]
        out.append(
            f"  {words[k]:<37}{w['min_s'] * 1e3:9.2f}{w['median_s'] * 1e3:9.2f}{w['min_s'] / floor:9.1f}"
            f"{_mb(w['beyond_output_mb']):>11}{_mb(w['process_peak_mb']):>12}{_share(w):>9}".rstrip()
        )
    return out


def _plainly(name: str, case: dict) -> list[str]:
    """What of the ratios below is owed to the look-up."""
    who = case["contestants"]
    best = min(EXTRA[name], key=lambda k: who[k]["min_s"])
    shares = ", ".join(f"({letter}) {_share(who[k])}" for letter, k in zip("abc", PEERS, strict=True))
    ratios = ", ".join(f"{who[best]['min_s'] / who[k]['min_s']:.1f} ({SHORT[k]})" for k in OURS[name])
    return [
        f"  Table look-up is {shares} of the peers' time; ours is prepared and uses even nodes.",
        f"  Times faster than the fastest peer with more help ({WORDS[best].strip()}): {ratios}",
    ]


def _goals(name: str, case: dict, words: dict) -> list[str]:
    who = case["contestants"]
    out = [f"  {'times faster than':<24}{'(a)':>22}{'(b)':>22}{'(c)':>22}{'memory beyond MB':>22}"]
    for k in OURS[name]:
        cells = []
        for peer in PEERS:
            ratio, goal = who[peer]["min_s"] / who[k]["min_s"], GOALS.get(k, {}).get(peer)
            cells.append(f"{ratio:.0f}" + ("" if goal is None else f" (goal {goal}{_verdict(ratio >= goal)})"))
        beyond = who[k]["beyond_output_mb"]
        cells.append("not measured" if beyond is None else f"{beyond:.1f} (goal {MEMORY_MB}{_verdict(beyond < MEMORY_MB)})")
        out.append(f"  {words[k]:<24}" + "".join(f"{c:>22}" for c in cells))
    return out


def _results(case: dict, words: dict) -> list[str]:
    out = [f"  {'largest difference, mm, from':<37}{'rule G':>12}{'exact chain':>14}"]
    for k, a in case["agreement"].items():
        out.append(f"  {words[k]:<37}{a['to_first_order_mm']:12.1e}{a['to_exact_mm']:14.1e}{'' if a['ok'] else '   DIFFERS'}")
    return out


def _floor(case: dict) -> float:
    """One core that copies the points; all cores together, or writing alone, may be faster."""
    return float(case["contestants"]["copy"]["min_s"])


def _verdict(met: bool) -> str:
    return ": met" if met else ": NOT MET"


def _share(w: dict) -> str:
    return "-" if w["look_up_s"] is None else f"{w['look_up_s'] / w['min_s']:.0%}"


def _mb(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
