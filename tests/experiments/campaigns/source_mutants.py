# ruff: noqa: E501 - an edit names the line that it replaces
"""Mistakes that somebody could make in the product, as text, and the tests that have to notice them.

Those of the push protocol that its sweep of faults notices stand in `tests.push.mutants`.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Mutant:
    """``old`` stands exactly once in the file ``path``; with ``new`` instead at least one of ``tests`` has to fail. ``fast``: in CI."""

    name: str
    path: str
    old: str
    new: str
    tests: tuple[str, ...]
    fast: bool = False


SINGLE = "tests/push/test_single_protections.py"
GATE = "tests/drivers/test_ballbar_gate.py"
AROUND = "tests/push/test_push_and_people.py"
SIGN = "tests/models/compensation/test_correction_sign.py"
KINDS = "tests/models/compensation/test_tables_kinds.py"
GRID = "tests/models/compensation/test_tables_grid.py"
WIRE = "tests/service/push/test_tables_on_the_wire.py"
CODEC = "tests/drivers/test_tables.py"
BANKS = "tests/drivers/contract/test_cnc_banks.py"
LASER = "tests/drivers/contract/test_laser.py"
SILENT = "tests/service/sequences/test_watch_laser.py::test_a_laser_that_is_silent_for_too_long_ends_the_test"
UNVERIFIED = "tests/push/test_unverified_tables.py"
PROPOSALS = "tests/scenarios/test_proposals.py"
MACHINE, BACK, LEARN = "service/push/machine.py", "service/push/back.py", "service/push/operations.py"
TABLES, BEST, ADAPTER = "models/compensation/tables.py", "models/compensation/nine_tables.py", "service/push/execute.py"
NOT_SAFE = '    if truth.unsafe:\n        return _pending(state, f"not safe now: {truth.unsafe}")\n'

MUTANTS = (
    Mutant("lease that ends while it is activated", MACHINE, "truth.lease_ms < LEASE_LEFT_MS", "truth.lease_ms < 0", (SINGLE + "::test_a_lease_that_is_about_to_end_is_no_time_to_activate",), True),
    Mutant("reference of a table one unit off", "service/push/validate.py", "abs(v[0]) > ZERO_MM", "abs(v[0]) > 500 * ZERO_MM", ("tests/push/test_bad_tables.py::test_the_reference_stays_where_it_is",), True),
    Mutant("jitter of the ball-bar's clock eight times wider", "drivers/ballbar/stream.py", "_JITTER = 0.05", "_JITTER = 0.4", (GATE + "::test_a_clock_that_is_off_by_more_than_a_twentieth_of_a_period_does_not_confirm_the_number",), True),
    Mutant("sign of the nine tables", BEST, "corrections.append(-(relative @", "corrections.append((relative @", (SIGN + "::test_an_axis_that_goes_too_far_is_told_to_go_less_far",), True),
    Mutant("sign of the grid", "models/compensation/grid.py", "rigid @ frame - error", "rigid @ frame + error", (SIGN,)),
    Mutant("sign of single motions", "models/compensation/achievable.py", "return -deviation_mm(", "return deviation_mm(", (SIGN,)),
    Mutant("sign of squareness parameters", "models/compensation/achievable.py", "out[:, first] -= sign", "out[:, first] += sign", (KINDS + "::test_parameters_and_their_tables_correct_the_same_distances_as_the_nine",)),
    Mutant("sign of cross tables beside squareness", "models/compensation/achievable.py", "np.where(cross, -(straight @", "np.where(cross, (straight @", (KINDS + "::test_parameters_and_their_tables_correct_the_same_distances_as_the_nine",)),
    Mutant("sign of what is already in force", "service/tables/nine_tables.py", "change.correction_mm[a] + np.column_stack(old)", "change.correction_mm[a] - np.column_stack(old)", (WIRE,)),
    Mutant("tables rounded down", TABLES, "tuple(np.round(c / lsb_mm)", "tuple(np.floor(c / lsb_mm)", (WIRE,)),
    Mutant("tables rounded up", TABLES, "tuple(np.round(c / lsb_mm)", "tuple(np.ceil(c / lsb_mm)", (WIRE,)),
    Mutant("encoder rounds down", "service/tables/nine_tables.py", "np.round(tables.correction_mm", "np.floor(tables.correction_mm", (WIRE,)),
    Mutant("encoder rounds up", "service/tables/nine_tables.py", "np.round(tables.correction_mm", "np.ceil(tables.correction_mm", (WIRE,)),
    Mutant("grid rounded down", "models/compensation/grid.py", "np.round(table.correction_mm / lsb_mm)", "np.floor(table.correction_mm / lsb_mm)", (GRID + "::test_rounding_costs_what_is_stated_and_keeps_the_reference",)),
    Mutant("grid rounded up", "models/compensation/grid.py", "np.round(table.correction_mm / lsb_mm)", "np.ceil(table.correction_mm / lsb_mm)", (GRID + "::test_rounding_costs_what_is_stated_and_keeps_the_reference",)),
    Mutant("positions of a table rounded down", "drivers/tables.py", "    return round(exact)", "    return math.floor(exact)", (CODEC,)),
    Mutant("a fence whose answer is lost counts", LEARN, "return known if isinstance(outcome, Unanswered) else known._replace(fenced=True, lease=0)", "return known._replace(fenced=True, lease=0)", (SINGLE,)),
    Mutant("a silent laser is waited for a hundred times longer", "service/sequences/watch.py", "LASER_UNKNOWN_S = 2.5", "LASER_UNKNOWN_S = 250.0", (SILENT,)),
    Mutant("a silent laser counts as one of which only the air is asked", "service/sequences/watch.py", "LASER_UNKNOWN_S if self.beam else", "self._w.air_unknown_s if self.beam else", (SILENT,)),
    Mutant("air of a silent laser is never missed", "service/sequences/watch.py", "if clock() - heard_s > longest_s:", "if clock() - heard_s > longest_s and self.beam:", (SILENT,)),
    Mutant("an old sample of the laser is taken for a new one", "drivers/laser/driver.py", "0 < (reading.sample_count - count)", "0 <= (reading.sample_count - count)", (LASER,)),
    Mutant("RELEASE that was passed over is believed", "drivers/cnc/banks.py", "(command == reg.RELEASE and holder == owner)", "False", (BANKS + "::test_a_command_that_was_passed_over_is_sent_again_under_the_next_number", BANKS + "::test_a_lease_whose_number_another_program_took_is_not_believed")),
    Mutant("SEAL that was passed over is believed", "drivers/cnc/banks.py", "not in _SEALED", "in ()", (BANKS + "::test_a_command_that_was_passed_over_is_sent_again_under_the_next_number",)),
    Mutant("LEASE that was passed over is believed", "drivers/cnc/banks.py", "(holder != owner) if command == reg.LEASE", "False if command == reg.LEASE", (BANKS + "::test_a_command_that_was_passed_over_is_sent_again_under_the_next_number", BANKS + "::test_a_lease_whose_number_another_program_took_is_not_believed")),
    Mutant("refused RELEASE of a free lease is asked for again and again", "drivers/cnc/banks.py", "return holder == owner or (command == reg.LEASE and holder == 0)", "return holder == owner or (command in (reg.LEASE, reg.RELEASE) and holder == 0)", (BANKS + "::test_releasing_a_free_lease_is_done_at_once_whatever_the_control_calls_it",)),
    Mutant("no second look after a refused activation", "service/compensation/pushing.py", "            await self._look_again(ended)\n", "", (AROUND + "::test_a_control_that_refuses_an_activation_and_does_it_later_is_found",)),
    Mutant("why a push was given up is forgotten", LEARN, "stop=known.stop or op.text)", "stop=known.stop)", (SINGLE,)),
    Mutant("way back against an e-stop: looked at only before the activation", BACK, NOT_SAFE + "    if truth.states", "    if truth.states", (SINGLE,)),
    Mutant("way back against an e-stop: not looked at before the activation", BACK, NOT_SAFE + "    return", "    return", ("tests/push/test_sweep.py::test_no_single_fault_violates_anything",)),
    Mutant("interlocks do not reach the push", ADAPTER, "unsafe = trouble.detail if trouble else", 'unsafe = "" if trouble else', (AROUND + "::test_moving_axes_and_an_open_door_reach_the_push_as_not_safe",)),
    Mutant("moving axes do not reach the push", ADAPTER, '"the axes move" if status.moving else ""', '""', (AROUND + "::test_moving_axes_and_an_open_door_reach_the_push_as_not_safe",)),
    Mutant("approval an hour longer in the push", MACHINE, "truth.now_s >= known.approved_until_s", "truth.now_s >= known.approved_until_s + 3600.0", (AROUND + "::test_who_orders_a_push_approves_it_for_an_hour_and_not_for_longer",)),
    Mutant("approval an hour longer than its text says", "service/compensation/pushing.py", "self.clock.monotonic_s() + APPROVED_S)", "self.clock.monotonic_s() + APPROVED_S + 3600.0)", (AROUND + "::test_who_orders_a_push_approves_it_for_an_hour_and_not_for_longer",)),
    Mutant("approval of a proposal an hour longer", "service/compensation/proposal_decisions.py", "elif now_s >= _utc_s(row.expiry):", "elif now_s >= _utc_s(row.expiry) + 3600.0:", (PROPOSALS + "::test_an_approval_ends_and_binds_who_and_what",)),
    Mutant("axes need not have stood", MACHINE, "STILL_S = 1.0", "STILL_S = 0.0", (SINGLE,)),
    Mutant("whatever stands in the bank is ours", BACK, "return len(content) == len(base) and all(is_ == wanted or not any(is_) for is_, wanted in chunks)", "return True", (SINGLE,)),
    Mutant("nothing that stands in the bank is ours", BACK, "return len(content) == len(base) and all(is_ == wanted or not any(is_) for is_, wanted in chunks)", "return False", (SINGLE,)),
    Mutant("lost lease is not seen in the last look", MACHINE, "if truth.owner != f.owner:", "if False:", (SINGLE,)),
    Mutant("lost lease does not end the measurement", ADAPTER, "                except Refused:\n                    lost.set()\n                    return\n", "                except Refused:\n                    return\n", (AROUND + "::test_a_measurement_ends_when_another_takes_the_lease_and_its_table_is_not_kept",)),
    Mutant("active bank after ACTIVATE not asked (driver)", "drivers/cnc/banks.py", "if active != bank:", "if False:", (BANKS + "::test_acknowledged_but_not_active_is_a_fault",)),
    Mutant("active bank after ACTIVATE not asked (push)", MACHINE, '(in_force(f, known.start) != "candidate" or known.start.boot', "(known.start.boot", (SINGLE,)),
    Mutant("an unverified table in force is not refused", "service/tables/table_gate.py", "    if now.unverified is not None:\n        whose", "    if False:\n        whose", (UNVERIFIED,)),
    Mutant("no table is unverified", "service/tables/known_tables.py", "if crc not in endorsed}", "if False}", (UNVERIFIED,)),
    Mutant("a table that once was a base is fine", "service/tables/known_tables.py", "            if base not in candidates:\n", "            if True:\n", (UNVERIFIED,)),
    Mutant("a kept table is unverified", "service/tables/known_tables.py", "endorsed.add(pushed[push])", "endorsed.discard(pushed[push])", (UNVERIFIED,)),
    Mutant("a table that a person vouched for is unverified", "service/tables/known_tables.py", "endorsed.add(known.accepted_crc)", "endorsed.discard(known.accepted_crc)", (UNVERIFIED,)),
)  # fmt: skip
