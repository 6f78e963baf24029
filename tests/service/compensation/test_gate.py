"""The gate before a push says everything that speaks against it at once, and lets nothing pass by."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from abbe.service.compensation import gate
from abbe.service.compensation.gate import PushContext, check_promise
from abbe.service.compensation.proved_levels import LevelStatus
from abbe.service.errors import TableRefused
from abbe.service.push.journal import Capabilities
from abbe.service.push.validate import PushLimits


class Control:
    """What the gate asks, answered as each test wants it; ``asked``: what was asked."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, *, commissioned: bool = True, level: bool = True,
        reasons: tuple[str, ...] = (), recovered: bool = False,
    ) -> None:  # fmt: skip
        self.asked: list[str] = []

        def answers(name: str, good: bool, detail: str, remedy: str) -> Any:
            async def check(*_: object, **options: object) -> LevelStatus:
                self.asked.append(name)
                if not good:
                    raise TableRefused(detail, remedy)
                return LevelStatus(Capabilities(), "a hint")

            return check

        async def precheck(*_: object, **options: object) -> Any:
            self.asked.append(f"precheck attended={options['attended']}")
            return SimpleNamespace(reasons=lambda: list(reasons))

        monkeypatch.setattr(gate, "recover", answers("recover", True, "", ""))
        monkeypatch.setattr(gate, "check_devices", answers("devices", True, "", ""))
        monkeypatch.setattr(gate, "check_commissioned", answers("commissioned", commissioned, "never proved", "abbe comp commission"))
        monkeypatch.setattr(gate, "check_level", answers("level", level, "level 1 is too low", "a person has to attend"))
        monkeypatch.setattr(gate, "load", lambda *_: None)
        monkeypatch.setattr(gate, "precheck", precheck)
        site = SimpleNamespace(machine=None, watching=SimpleNamespace(air_c=None))
        monkeypatch.setattr(gate, "verification", lambda *_, **__: None)
        self.context = PushContext(
            cast("Any", SimpleNamespace(controller=None, recovered=recovered)), cast("Any", None), cast("Any", site), attended=False
        )


async def test_all_reasons_come_at_once_with_the_first_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    control = Control(monkeypatch, commissioned=False, level=False, reasons=("STALE: measured 80 h ago", "APPROVAL: none"))
    with pytest.raises(TableRefused) as closed:
        await gate.admit(control.context, 4)
    assert closed.value.reasons == ("never proved", "level 1 is too low", "STALE: measured 80 h ago", "APPROVAL: none")
    assert closed.value.remedy == "abbe comp commission"


async def test_each_question_is_asked_once_and_the_old_push_comes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    control = Control(monkeypatch)
    admission = await gate.admit(control.context, 4)
    assert control.asked == ["recover", "devices", "commissioned", "level", "precheck attended=False"]
    assert admission.hint == "a hint"


async def test_a_session_that_recovered_when_it_was_opened_does_not_recover_again(monkeypatch: pytest.MonkeyPatch) -> None:
    control = Control(monkeypatch, recovered=True)
    await gate.admit(control.context, 4)
    assert control.asked == ["devices", "commissioned", "level", "precheck attended=False"]


async def test_what_was_asked_before_the_proposal_was_made_is_not_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    control = Control(monkeypatch)
    await gate.admit(control.context, 4, await gate.check_preconditions(control.context))
    assert control.asked == ["recover", "devices", "commissioned", "level", "precheck attended=False"]


async def test_before_a_proposal_only_the_control_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    control = Control(monkeypatch)
    assert (await gate.check_preconditions(control.context)).hint == "a hint"
    assert control.asked == ["recover", "devices", "commissioned", "level"]


async def test_a_control_that_was_never_proved_stops_the_measurement_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    control = Control(monkeypatch, commissioned=False)
    with pytest.raises(TableRefused, match="never proved"):
        await gate.check_preconditions(control.context)


@pytest.mark.parametrize(
    ("before_um", "after_um", "u_um", "why"),
    [
        (9.9, 4.0, 10.3, "determine the errors too poorly: measure more"),
        (10.0, 2.0, 4.5, "determine the errors too poorly: measure more"),
        (10.0, 6.0, 2.5, "determine the errors too poorly: measure more"),
        (4.7, 4.2, 0.9, "determine the errors too poorly: measure more"),
        (4.7, 4.4, 0.9, "tables of this kind remove no more"),
        (10.0, 9.9, 0.01, "tables of this kind remove no more"),
    ],
)
def test_tables_that_promise_too_little_are_refused_with_the_true_reason(before_um: float, after_um: float, u_um: float, why: str) -> None:
    """A torso of a campaign is not a machine that is as good as it can be."""
    predicted = SimpleNamespace(before_mm=before_um * 1e-3, after_mm=after_um * 1e-3, u_model_mm=u_um * 1e-3)
    with pytest.raises(TableRefused, match="not enough to write") as refused:
        check_promise(cast("Any", predicted), PushLimits())
    assert why in refused.value.remedy
