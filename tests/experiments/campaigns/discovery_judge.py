"""Answers of the discovery judged against sealed truths: naming, false names, unknowns, ambiguity, predictions, strengths.

Definitions: docs of the answer format (run-format.md 5) and of the sealed truths. An effect counts as visible from snr_total 10 on
(unknown ones from 20 on); naming an alias counts; of a sealed run only a laser's zero, or centre and length of a set-up never seen, may be
refitted; readings farther off than 6 robust deviations of a laser run are lost beams and nobody's to foretell.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from abbe.models.arrays import F1

Doc = dict[str, Any]
VISIBLE = 10.0
ASKED_FROM = {"single": VISIBLE, "unknown": 2 * VISIBLE}
"""Below, nobody can be expected to see the one effect: only false names count."""
KEYLESS = {
    "contour_lag", "ram_sag", "bar_thermal", "bar_length_error", "setup_centre_offset", "mirror_tilt", "laser_cosine", "air_refraction",
    "dead_path", "beam_outliers",
}  # fmt: skip
STRAIGHT_PLANS = ("full", "ballbar", "one_way", "one_feed", "one_radius")


@dataclass
class Tally:
    """Counts, each [hits, of], and samples of what is summed up by quantiles."""

    counts: dict[str, list[int]] = field(default_factory=dict)
    samples: dict[str, list[float]] = field(default_factory=dict)
    wrong: Counter[str] = field(default_factory=Counter)

    def count(self, what: str, hits: float, of: int = 1) -> None:
        """Add to a share."""
        entry = self.counts.setdefault(what, [0, 0])
        entry[0] += int(hits)
        entry[1] += of

    def sample(self, what: str, value: float) -> None:
        """Add to a sample."""
        self.samples.setdefault(what, []).append(value)


def label(effect: Doc | str) -> str:
    """``name:key`` of an effect of an answer or a truth."""
    name, _, inside = (effect if isinstance(effect, str) else str(effect["name"])).partition(":")
    key = inside or ("" if isinstance(effect, str) else effect.get("key") or "")
    return name if name in KEYLESS or not key else f"{name}:{key}"


def judge(tally: Tally, truth: Doc, answer: Doc) -> bool:
    """Count one answer; gives whether its naming is right (or too little was visible to ask for it)."""
    effects = sorted(answer.get("effects") or [], key=lambda e: -float(e.get("evidence") or 0)) if answer["verdict"] != "none" else []
    names = [label(e) for e in effects]
    good = {e["label"]: {e["label"], *e["aliases"], *e["explained_by_catalogue"]} for e in truth["effects"]}
    allowed = set().union(*good.values()) if good else set()
    if truth["kind"] == "unknown":
        allowed |= {truth["effects"][0]["name"], truth["effects"][0]["label"]}
    false = [n for n in names if n not in allowed]
    tally.count("false names", len(false), len(names))
    if truth["kind"] in ASKED_FROM and truth["effects"][0]["snr_total"] < ASKED_FROM[truth["kind"]]:
        return True
    right = _kind(tally, truth, answer, effects, names, good, false)
    for e in truth["effects"]:
        if e["snr_total"] >= VISIBLE and e["in_catalogue"]:
            tally.count("recall of visible effects", any(n in good[e["label"]] for n in names))
            _strength(tally, e, effects)
    if all(e.get("predictable", True) for e in truth["effects"]):
        _gaps(tally, truth, answer)
    return right


def _kind(tally: Tally, truth: Doc, answer: Doc, effects: list[Doc], names: list[str], good: dict[str, set[str]], false: list[str]) -> bool:
    kind, verdict = truth["kind"], answer["verdict"]
    visible = [e for e in truth["effects"] if e["snr_total"] >= VISIBLE]
    right = True
    if kind == "null":
        right = verdict == "none"
        tally.count("null: false alarms", not right)
    elif kind == "unknown":
        e = truth["effects"][0]
        right = verdict == "unknown" or any(n in good[e["label"]] or n.split(":")[0] == e["name"] for n in names[:1])
        tally.count("outside of the catalogue: unknown", right)
        found = located(e["where"], answer.get("where") or {})
        if found is not None:
            tally.count("... located", found)
    elif kind == "single":
        right = _single(tally, truth, answer, effects, names, good)
    elif kind == "double" and len(visible) == 2:
        right = all(any(n in good[e["label"]] for n in names) for e in visible) and not false
        tally.count("two effects: both, nothing else", right)
    if not right:
        asked = "+".join(sorted(e["name"] for e in truth["effects"])) or "nothing"
        tally.wrong[f"{asked} -> {'+'.join(n.split(':')[0] for n in names) or verdict}"] += 1
    return right


def _single(tally: Tally, truth: Doc, answer: Doc, effects: list[Doc], names: list[str], good: dict[str, set[str]]) -> bool:
    e = truth["effects"][0]
    hit = bool(names) and names[0] in good[e["label"]]
    tally.count("one effect, snr_total >= 10", hit)
    if e["snr_local"] >= 2:
        tally.count("one effect, snr_local >= 2", hit)
        if truth["plan"] in STRAIGHT_PLANS:
            tally.count("... plans full/ballbar/one_*", hit)
    said = {label(x) for x in answer.get("confounded_with") or []} | {label(x) for f in effects for x in f.get("alternatives") or []}
    if e["aliases"]:
        stated = bool(said & set(e["aliases"])) or (bool(names) and names[0] in e["aliases"] and e["label"] in said)
        tally.count("ambiguity stated where there is one", stated)
        separating = {a for v in e["separated_by"].values() for a in v}
        if separating:
            tally.count("... separating measurement proposed", bool(separating & set((answer.get("next_test") or {}).get("adds") or [])))
    else:
        tally.count("ambiguity stated where there is none", bool(said))
    return hit


def located(truth: Doc, where: Doc) -> bool | None:
    """Whether an answer's ``where`` is where the truth is: 60 s, two radii, 10 % of a period, exact lobes; None: nothing to locate."""
    if "time_s" in truth:
        t = where.get("time_s")
        return bool(t) and t[0] <= truth["time_s"][1] + 60 and t[1] >= truth["time_s"][0] - 60
    if "position_mm" in truth:
        p = where.get("position_mm")
        return bool(p) and math.dist(p, truth["position_mm"]) <= 2 * truth["radius_mm"]
    if "period_s" in truth:
        p = where.get("period_s")
        return bool(p) and abs(p / truth["period_s"] - 1) < 0.1
    return where.get("angular_lobes") == truth["angular_lobes"] if "angular_lobes" in truth else None


def _strength(tally: Tally, truth: Doc, effects: list[Doc]) -> None:
    for found in effects:
        given = found.get("parameters") or {}
        true = truth["parameters"]["strength"]
        if label(found) == truth["label"] and given.get("strength") is not None and true:
            if truth["snr_local"] >= 2:
                tally.sample("strength error, snr_local >= 2", abs(abs(given["strength"]) - abs(true)) / abs(true))
            if given.get("u_strength"):
                tally.count("truth within +-2u", abs(given["strength"] - true) <= 2 * given["u_strength"])


def _gaps(tally: Tally, truth: Doc, answer: Doc) -> None:
    for seen, what in ((True, "seen"), (False, "new origin")):
        sums, n = np.zeros(3), 0
        for run_id, run in truth["sealed_runs"].items():
            if run["setup_seen"] != seen or run_id not in (answer.get("predictions") or {}):
                continue
            before = (answer.get("predictions_before") or {}).get(run_id, run["without_effect_mm"])
            for k, guess in enumerate((answer["predictions"][run_id], before, run["clean_mm"])):
                left, free = _left(run, guess)
                sums[k] += left @ left / run["sigma_um"] ** 2
                n += free if k == 0 else 0
        if not n:
            continue
        after, before, floor = np.sqrt(sums / n)
        tally.sample(f"sealed runs, {what}, rms/floor", after / floor)
        if what == "new origin" and truth["plan"] == "full":
            tally.count("sealed runs, new origin, plan full, <= 1.15 floor", after / floor <= 1.15)
        if what == "seen":
            tally.count("sealed runs, seen, <= 1.10 floor", after / floor <= 1.10)
        if truth["kind"] in ("single", "double") and before > 2 * floor:
            tally.sample("gap closed", 1 - math.sqrt(max(0.0, after**2 - floor**2) / (before**2 - floor**2)))


def _left(run: Doc, guess: list[float]) -> tuple[F1, int]:
    """Residual of a sealed run in um, what may be refitted refitted, and its degrees of freedom."""
    left = np.asarray(run["deviation_mm"], dtype=np.float64) - np.asarray(guess, dtype=np.float64)
    free = np.zeros((len(left), 0))
    if run["test"] == "laser_diagonal":
        free = np.ones((len(left), 1))
    elif not run["setup_seen"]:
        look = (np.array(run["xyz_mm"]) - np.array(run["info"]["centre_mm"])) / run["info"]["radius_mm"]
        free = np.hstack([look, np.ones((len(left), 1))])
    if free.shape[1]:
        left = left - free @ np.linalg.lstsq(free, left, rcond=None)[0]
    if run["test"] == "laser_diagonal":
        left = left[np.abs(left) <= 6 * max(float(np.median(np.abs(left))) / 0.6745, 1e-9)]
    return 1e3 * left, len(left) - free.shape[1]
