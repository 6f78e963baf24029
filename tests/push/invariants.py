"""I1-I20 of reliability.md 3.4, each a checker of its own over everything that happened in a world. Written without the protocol's code.

I1 is looked at after every request (`World.instant`). What the model cannot say is said at the checker.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Callable
from typing import Any

OPS_AFTER_QUIET = 120
"""I18: at a quarter of a second each, 30 s."""
PERMITS = {"ACTIVATING": "candidate", "ACTIVATING_BACK": "base"}
MOTION = {"PROBE": "PROBATION", "VERIFY": "PROBED"}
TERMINAL = {"REJECTED", "ABORTED", "KEEP", "ROLLED_BACK", "OPERATOR"}


def _issued(world: Any, *kinds: str) -> list[tuple]:
    return [event for event in world.events if event[0] == "issue" and event[1] in kinds]


def _of(world: Any, *names: str) -> list[tuple]:
    return [event for event in world.events if event[0] in names]


def _records(world: Any) -> list[tuple]:
    return _of(world, "record")


def _state(world: Any) -> str:
    return str(world.journal[-1].state) if world.journal else ""


def i1_only_verified_tables_in_force(world: Any) -> bool:
    return not world.bad_instants


def i2_active_bank_never_written(world: Any) -> bool:
    """No write lands in the active bank, and none is sent to a bank that the last look saw active."""
    landed = any(on_active and not refused for _, _, on_active, refused in _of(world, "write"))
    known = any(look is not None and look[0].active == op.bank for _, _, op, _, _, _, look in _issued(world, "WRITE"))
    return not landed and not known


def i3_interlocks_true_when_executed(world: Any) -> bool:
    """And none is sent when the last look said that they are not: who fights the machine relies on it."""
    sent = any(look[0].unsafe for _, _, _, _, _, _, look in _issued(world, "ACTIVATE"))
    return not sent and not any(estop for _, _, _, _, _, _, estop, _, _ in _of(world, "activated"))


def i4_one_activation_per_entry(world: Any) -> bool:
    seen = [last.seq if last else -1 for _, _, _, _, last, _, _ in _issued(world, "ACTIVATE")]
    return len(seen) == len(set(seen))


def i5_intent_durable_first(world: Any) -> bool:
    for _, _, op, state, last, _, _ in _issued(world, "ACTIVATE"):
        if str(state) not in PERMITS:
            return False
        doc = last.doc
        if (doc.get("expect_gen"), doc.get("expect_crc")) != (op.gen, op.crc) and (doc.get("back_gen"), doc.get("back_bank")) != (
            op.gen,
            op.bank,
        ):
            return False
    return True


def i6_full_read_back_first(world: Any) -> bool:
    """Before an activation was sent, its process read the bank in full (the new table twice) in the generation that it names."""
    reads: list[tuple] = []
    for event in world.events:
        if event[0] in ("read", "read_again"):
            reads.append(event)
        elif event[0] == "issue" and event[1] == "ACTIVATE":
            op, process = event[2], event[5]
            wanted = world.candidate if str(event[3]) == "ACTIVATING" else world.base
            found = {kind for kind, bank, _, gen, data, by in reads if (bank, gen, data, by) == (op.bank, op.gen, wanted, process)}
            if not ({"read", "read_again"} if wanted == world.candidate else {"read"}) <= found:
                return False
    return True


def _binding(world: Any, image: bytes) -> str:
    """What the approval of this image on the base of the snapshot has to be, by this file's own computation."""
    text = json.dumps([image.hex(), world.base.hex(), "M", "limits", "then"], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def only_approved(world: Any, forward: list[bytes]) -> bool:
    """Each of these images was approved for exactly the base of the snapshot."""
    approved = [entry.doc["approval"] for _, entry, _, _, _ in _records(world) if "approval" in entry.doc]
    return all(approved and approved[0] == _binding(world, image) for image in forward)


def i7_approved_is_what_was_staged(world: Any) -> bool:
    return only_approved(world, [e[2] for e in _of(world, "activated") if e[2] != world.base])


def i8_base_as_approved_when_activated(world: Any) -> bool:
    return all(before == world.base for _, _, content, before, *_ in _of(world, "activated") if content != world.base)


def i9_base_restorable(world: Any) -> bool:
    if not world.journal:
        return True
    doc = world.journal[0].doc
    image = bytes.fromhex(doc["base_image"])
    return zlib.crc32(image) == doc["base_crc"] and (image == world.base or image in world.ctl.human or image == world.ctl.factory)


def i10_terminal_agrees_with_controller(world: Any) -> bool:
    """As of the last look before the entry: what changes after a look, no protocol can know. KEEP needs a look after the last motion."""
    looked = False
    for event in world.events:
        looked = event[1] == "LOOK" if event[0] == "issue" and event[1] in ("LOOK", "VERIFY") else looked
        if event[0] == "record" and str(event[1].state) == "KEEP" and not looked:
            return False
    for _, entry, look, _, _ in _records(world):
        state = str(entry.state)
        seen = look[1] if look else b""
        if state == "KEEP" and seen != world.candidate:
            return False
        if state == "OPERATOR" and seen == world.candidate and look[0].crc[1 - look[0].active] == zlib.crc32(world.base):
            return False
        human = world.ctl.human
        if state == "ABORTED" and world.ctl.in_force == world.candidate and world.candidate not in human:
            return False
    return True


def i11_rolled_back_is_base(world: Any) -> bool:
    return all(look[1] == world.base for _, entry, look, _, _ in _records(world) if str(entry.state) == "ROLLED_BACK")


def i12_one_lease_owner(world: Any) -> bool:
    """Whoever activates holds the lease, owner ids of a push never fall, and nothing is written when the last look shows another owner.

    Two real services at once are not part of the model, only the other's lease is.
    """
    if any(look[0].owner == world.foreign for _, _, _, _, _, _, look in _issued(world, "WRITE")):
        return False
    held = all(owner == holder != 0 for *_, owner, holder in _of(world, "activated"))
    taken = [owner for _, owner in _of(world, "leased")]
    return held and taken == sorted(taken)


def i13_hand_edits_survive(world: Any) -> bool:
    """A table that a person put in force is not switched away, and a bank that the last look showed changed is not written.

    What a person does between a look and the next request cannot be seen by a host, whose writes carry no condition: not expressible.
    """
    if any(before in world.ctl.human and before not in (world.base, world.candidate) for _, _, _, before, *_ in _of(world, "activated")):
        return False
    touched: set[int] = set()
    shown: set[int] = set()
    for event in world.events:
        if event[0] == "hand" and not event[2]:
            touched.add(event[1])
        elif event[0] == "reboot" or (event[0] == "record" and str(event[1].state) == "SNAPSHOT"):
            touched.clear()
            shown.clear()
        elif event[0] == "issue" and event[1] == "WRITE" and event[2].bank in shown:
            return False
        elif event[0] == "issue" and event[6] is not None:
            look = event[6][0]
            shown |= {bank for bank in touched if look.gen >= world.gen_of_edit.get(bank, 1 << 30)}
    return True


def i14_recovery_is_idempotent(world: Any) -> bool:
    return bool(world.idempotent)


def i15_one_audit_row_per_transition(world: Any) -> bool:
    """The chain, recomputed here; sequence numbers without gap."""
    head = "0" * 64
    for k, entry in enumerate(world.journal):
        text = json.dumps(
            [entry.push, entry.seq, str(entry.state), entry.doc, entry.utc, entry.prev],
            sort_keys=True,
            separators=(",", ":"),
            ensure_ascii=False,
        )
        if entry.prev != head or entry.seq != k or hashlib.sha256(text.encode()).hexdigest() != entry.digest:
            return False
        head = entry.digest
    return len(_records(world)) == len(world.journal)


def i16_no_motion_when_unconfirmed(world: Any) -> bool:
    """Motion only on probation, by the process that confirmed, and not after an operation of it went wrong since then."""
    confirmed, wrong = -1, False
    for event in world.events:
        if event[0] == "record" and str(event[1].state) == "PROBATION":
            confirmed, wrong = event[4], False
        elif event[0] == "record" and str(event[1].state) in ("ROLLBACK", *TERMINAL):
            confirmed = -1
        elif event[0] == "issue" and event[1] in MOTION:
            look = event[6][0]
            if str(event[3]) != MOTION[event[1]] or event[5] != confirmed or wrong or look.unsafe:
                return False
    return True


def i17_rejected_writes_nothing(world: Any) -> bool:
    return _state(world) != "REJECTED" or not _of(world, "write", "activated", "leased")


def i18_ends_in_bounded_time(world: Any) -> bool:
    return bool(world.settled) and world.ops_after_quiet <= OPS_AFTER_QUIET


def i19_keep_was_proved(world: Any) -> bool:
    if _state(world) != "KEEP":
        return True
    probed = any(content == world.candidate and good for _, content, good in _of(world, "probed"))
    return probed and any(content == world.candidate and good for _, content, good in _of(world, "verified"))


def i20_unattended_only_at_level_three(world: Any) -> bool:
    """Only the level is part of the model; the figures of the policy (a day between pushes, drift) are rows of the table test."""
    return world.case.level == 3 or world.case.attended or not _of(world, "activated", "write")


def c3_nothing_is_kept_over_a_restart(world: Any) -> bool:
    """Reliability.md 2c C3: a new boot id makes everything void that was begun before."""
    kept = [look for _, entry, look, _, _ in _records(world) if str(entry.state) == "KEEP"]
    return all(look[0].boot == world.journal[0].doc["boot"] for look in kept)


CHECKS: dict[str, Callable[[Any], bool]] = {
    name.split("_")[0].upper(): f for name, f in list(globals().items()) if name[:1] in "ic" and name[1:2].isdigit()
}


def violations(world: Any, ended: Any, again: Any, *, idempotent: bool) -> list[str]:
    """Names of the invariants that do not hold."""
    world.idempotent = idempotent and (again is None or ended is None or again.state == ended.state)
    world.settled = ended is not None and ended.settled
    return [name for name, check in world.checks.items() if not check(world)]
