"""Results of a discovery's demonstration as lines for the terminal and as JSON, judged by the sealed truth."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from abbe.service.demo.demo_hidden import HiddenDemo
from abbe.service.discovery.discovery_answer import where_doc
from abbe.service.discovery.discovery_text import book_lines, effect_lines, next_of, verdict_of
from abbe.service.domain.finding import GapUm
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.rendering.numbers import plain

FORMAT = "abbe-hidden-demo/1"


def summary_lines(result: HiddenDemo) -> list[str]:
    """Results line by line, in the order of the job."""
    finding = result.finding
    _, word, text = verdict_of(finding)
    lines = [f"measured: {len(finding.runs)} runs, {sum(r.readings for r in finding.runs.values())} readings"]
    lines += [f"{word}. {text}"]
    lines += [f"{role} runs: {_gap_text(g)}" for role, g in finding.gaps.items()]
    for effect in finding.effects:
        lines += effect_lines(effect)
    lines += next_of(finding) + _model(result) + _anew(result) + _tables(result)
    return [*lines, *truth_lines(result)]


def _gap_text(gap: GapUm) -> str:
    return f"gap {plain(gap.before_um)} -> {plain(gap.after_um)} µm rms, {plain(gap.floor_um)} µm is noise"


def _model(result: HiddenDemo) -> list[str]:
    version = None if result.journal is None else result.journal.version
    if version is not None:
        return [f"model book: version {version} of {result.site.name} knows it now"]
    return book_lines(result.finding) or ["model book: unchanged, nothing was proved that could enter it"]


def _anew(result: HiddenDemo) -> list[str]:
    if result.anew is None:
        return []
    runs = [f"  {label}: {_gap_text(r)}" for label, r in result.anew.runs.items()]
    return [f"new measurement at positions that no fit has used: {_gap_text(result.anew.gap)}", *runs]


def _tables(result: HiddenDemo) -> list[str]:
    c = result.correction
    if c is None:
        return [f"tables: none written: {result.refused}"] if result.refused else []
    kept = "kept" if c.decision.keep else "rolled back"
    lines = [f"tables for what tables take out (the 21 error motions): {kept}; {c.decision.text}"]
    return lines + [f"stays: {line}" for line in c.not_for_tables]


def hidden_label(truth: dict[str, Any]) -> str | None:
    """The hidden effect as ``name:key``; None if nothing was hidden."""
    secret = truth.get("hidden")
    if secret is None:
        return None
    return f"{secret['name']}:{secret['key']}" if secret["key"] else str(secret["name"])


def judged(result: HiddenDemo) -> tuple[bool, str]:
    """Whether the answer was right, and a sentence about it.

    Right answers: exactly the hidden name and key; ``none`` if nothing is hidden; ``unknown`` if the catalogue lacks the hidden effect.
    """
    label, finding = hidden_label(result.truth), result.finding
    named = [e.label for e in finding.effects]
    if label is None:
        right = finding.verdict == "none"
        return right, "nothing was hidden" + ("" if right else f"; the answer was {', '.join(named) or finding.verdict}")
    if result.truth["hidden"]["name"] not in {e.name for e in catalogue()}:
        right = finding.verdict == "unknown" and not named
        return right, f"hidden was {label}, which no catalogue names; the answer was {', '.join([finding.verdict, *named])}"
    right = finding.verdict == "named" and named == [label]
    also = [n for n in named if n != label]
    if label in named and also:
        return False, f"hidden was {label}, and it was named; but beside it {', '.join(also)}, which is not there"
    return right, f"hidden was {label}; the answer was {', '.join(named) or finding.verdict}"


def truth_lines(result: HiddenDemo) -> list[str]:
    """Lines that compare the answer with the sealed truth."""
    right, text = judged(result)
    lines = [f"sealed truth: {text}. {'RIGHT' if right else 'WRONG'}."]
    secret = result.truth.get("hidden")
    if secret is not None:
        values = ", ".join(f"{k} {v:g}" for k, v in secret["parameters"].items())
        bent = ", bent away from its formula" if secret["wild"] else ""
        lines.append(f"  it was made with {values}{bent}")
    return lines


def hidden_json(result: HiddenDemo) -> dict[str, Any]:
    """JSON output of `abbe demo --hidden SEED --json`."""
    finding, c = result.finding, result.correction
    fields = ("label", "name", "key", "strength", "u_strength", "unit", "remedy", "remedy_text")
    right, text = judged(result)
    doc: dict[str, Any] = {
        "format": FORMAT,
        "verdict": finding.verdict,
        "effects": [{k: getattr(e, k) for k in fields} for e in finding.effects],
        "where": where_doc(finding.where),
        "gaps": {role: asdict(gap) for role, gap in finding.gaps.items()},
        "model_version": None if result.journal is None else result.journal.version,
        "anew": None if result.anew is None else asdict(result.anew),
        "tables": None if c is None else {"kept": c.decision.keep, "verdict": c.decision.text, "stays": list(c.not_for_tables)},
        "tables_refused": result.refused or None,
        "hidden": result.truth.get("hidden"),
        "right": right,
        "judgement": text,
    }
    return doc | {"duration_s": round(result.duration_s, 1)}
