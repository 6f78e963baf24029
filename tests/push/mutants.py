# ruff: noqa: E501 - an edit names the line that it replaces
"""Mistakes that somebody could make in the protocol, as edits of its source: the sweep has to notice every one."""

from __future__ import annotations

from tests.push.loading import Edits

LOOKS_SAFE = ("machine", 'return f"not safe now: {truth.unsafe}" if truth.unsafe else ""', 'return ""')

MUTANTS: dict[str, Edits] = {
    "second read-back skipped": (
        ("operations", "step = bracket(known, image.bank, words, again=True)", "step = bracket(known, image.bank, words, again=False)"),
        ("operations", "known.image != image.data or (image.semantic_digest and known.decoded_digest != image.semantic_digest):", "known.image != image.data:"),
    ),
    "full read-back skipped": (
        (
            "operations",
            "step = bracket(known, image.bank, words, again=True)",
            "step = Operation(OperationKind.LOOK) if known.truth is None else Coherent(known.truth)",
        ),
        ("operations", "if known.image != image.data or (image.semantic_digest and known.decoded_digest != image.semantic_digest):", "if False:"),
    ),
    "journal after the action": (
        (
            "machine",
            'return record(PushState.ACTIVATING, expect_crc=f.crc, expect_gen=f.staged_gen)',
            'return record(PushState.ACTIVATING, expect_crc=f.crc, expect_gen=f.staged_gen) if known.asked else '
            'Operation(OperationKind.ACTIVATE, bank=f.target, crc=f.crc, gen=f.staged_gen, owner=f.owner)',
        ),
    ),
    "activation sent again blindly": (("machine", "not known.asked and not known.stop:", "(not known.asked or known.unanswered):"),),
    "only the first chunk compared": (("operations", "outcome.value == op.data:", "(op.first > 0 or outcome.value == op.data):"),),
    "boot id ignored": (
        ("machine", '(truth.boot, truth.gen) != (f.boot, f.probation_gen)', 'truth.gen != f.probation_gen'),
        ("machine", ' or known.start.boot != f.boot)', ")"),
    ),
    "generation of the snapshot used": (("machine", 'expect_gen=f.staged_gen)', 'expect_gen=f.gen)'),),
    "generation of the last look used": (
        ("machine", "if truth.gen != gen:", "if False:"),
        ("machine", 'expect_gen=f.staged_gen)', "expect_gen=truth.gen)"),
    ),
    "reasons noted, table written": (("machine", "reasons=reasons) if reasons else", "reasons=reasons) if False else"),),
    "approval of the machine's name": (
        ("journal", '[image.hex(), base_image.hex(), machine, limits, expiry]', '[machine, expiry]'),
    ),
    "approval without the base": (("journal", '[image.hex(), base_image.hex(), ', '[image.hex(), '),),
    "approval never ends": (("machine", "truth.now_s >= known.approved_until_s", "False"),),
    "way back without the old table": (
        ("back", 'if truth.states[other] is BankState.SEALED and truth.crc[other] == f.base_crc:', "if True:"),
        ("back", "if step is not None and known.image == base:", "if step is not None:"),
    ),
    "late command not shut out": (("machine", "if not known.fenced:\n        return Operation(OperationKind.RELEASE", "if False:\n        return Operation(OperationKind.RELEASE"),),
    "doubt taken for no": (("machine", "which = in_force(f, known.truth)", 'which = "base"'),),
    "axes exchanged in the encoder": (("codec", "np.round(tables.correction_mm[a][:, i] * 1e6", "np.round(tables.correction_mm[i][:, a] * 1e6"),),
    "sign exchanged in the encoder": (("codec", "np.round(tables.correction_mm[a][:, i] * 1e6", "np.round(-tables.correction_mm[a][:, i] * 1e6"),),
    "sign exchanged in encoder and decoder": (
        ("codec", "np.round(tables.correction_mm[a][:, i] * 1e6", "np.round(-tables.correction_mm[a][:, i] * 1e6"),
        ("second_decoder", "return value * _register(data, 6) / 1_000_000", "return -value * _register(data, 6) / 1_000_000"),
    ),
    "verification always passes": (("machine", "known.verdict.value.passed:", "(known.verdict.value.passed or question is OperationKind.VERIFY):"),),
    "probe always passes": (("machine", "known.verdict.value.passed:", "(known.verdict.value.passed or question is OperationKind.PROBE):"),),
    "kept without a last look": (("machine", "    step = _confirm(f, known)\n    if step is None:\n        return record(PushState.ROLLBACK", "    step = record(PushState.PROBATION)\n    if step is None:\n        return record(PushState.ROLLBACK"),),
    "recovery goes on with the probation": (("machine", "if not known.mine:\n        return \"interrupted", "if False:\n        return \"interrupted"),),
    "way back against an e-stop": (("back", "if truth.unsafe:\n        return _pending(state, f\"not safe now: {truth.unsafe}\")\n    if truth.states", "if False:\n        return _pending(state, \"\")\n    if truth.states"), ("back", "    if truth.unsafe:\n        return _pending(state, f\"not safe now: {truth.unsafe}\")\n    return", "    return")),
    "armed against an e-stop": (LOOKS_SAFE,),
    "new table written in place": (("machine", '"target": 1 - active}', '"target": active}'),),
    "a person's words overwritten": (("operations", "if (known.truth.boot, known.truth.gen) != (image.boot, image.gen + known.written):", "if False:"),),
    "a person's table switched away": (("back", 'if which == "neither":', "if False:"),),
    "journal not chained": (("journal", "str(state), doc, utc, prev]", 'str(state), doc, utc, ""]'),),
    "level not asked": (("machine", "    if no:\n", "    if False:\n"),),
    "way back without an entry": (
        (
            "back",
            "return _armed(step.truth, other, PushState.ROLLBACK)",
            'return Operation(OperationKind.ACTIVATE, bank=other, crc=f.base_crc, gen=step.truth.gen, owner=known.lease)',
        ),
    ),
    "another's lease not respected": (
        ("machine", "if isinstance(known.verdict, OperationRefused):\n        return _abandon(f, known, PushState.APPROVED", "if False:\n        return _abandon(f, known, PushState.APPROVED"),
        ("machine", "if isinstance(known.verdict, Done):\n        return record(PushState.LEASED)", "if known.verdict is not None:\n        return record(PushState.LEASED)"),
        ("machine", 'if truth.owner != f.owner:', "if False:"),
    ),
    "activated on a lease that ends": (("machine", "truth.lease_ms < LEASE_LEFT_MS", "truth.lease_ms < 0"),),
    "pushed into axes that only just stand": (("machine", "STILL_S = 1.0", "STILL_S = 0.0"),),
    "approval an hour longer": (("machine", "truth.now_s >= known.approved_until_s", "truth.now_s >= known.approved_until_s + 3600.0"),),
    "what is pending is forgotten": (("back", "    if known.rested:", "    if known.rested or state is PushState.ROLLBACK_PENDING:"),),
}  # fmt: skip
BY_PROBE = "sign exchanged in encoder and decoder"
"""No read-back can see this one."""
