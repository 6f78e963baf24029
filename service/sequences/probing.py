"""Touches one feature of an artefact: protected way there; repeated approach, touch and retract for each side; return above it.

Every way between the artefact's features is a touch command, too, so that an unexpected contact stops the axes. After a missed contact,
false trips or a stylus that stays deflected, the stylus is first withdrawn along its approach.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from abbe.drivers.api import Latch, Motion, Point, Probing, can_touch
from abbe.service.domain.document import parsed
from abbe.service.domain.measured import TouchedFeature
from abbe.service.errors import ConfigError, FalseTrips, MissedContact, Obstructed, ProbeNotReady, ProbeUncalibrated, SetupDisturbed
from abbe.service.runs.touches import found_feature
from abbe.service.sequences.steps import TouchFeature

AGREE_MM = 0.01
"""Repeated touches of one side agree within this; a trip by vibration does not."""
MORE_TOUCHES = 3
RADIUS_MM = 0.05
"""Allowed difference between measured and expected radius of a feature: it covers pre-travel and a hole's tolerance, not another stylus."""
MOVED_MM = 0.01
"""Allowed change of a feature that is touched again: it covers minutes of drift, not a plate that has slipped."""
QUALIFIED_MM, COVERAGE = 0.002, 2.0
"""Allowed change, by warming, of the first feature's radius when it is touched again, beyond the uncertainty of both radii; coverage
factor of that uncertainty."""
TOUCH_S = 30.0
RESEAT_S, POLL_S = 1.0, 0.02
"""How long a stylus may take to come back to rest after a touch (receivers report it late), and the interval of looks at it."""
_ANEW = "the points so far are kept as evidence, and Abbe measures the pose again from its start"
SAME_PLACE_MM = 1e-5


def need_probe(controller: object) -> Probing:
    """Return the controller if it can touch. Raises ConfigError."""
    if not can_touch(controller):
        raise ConfigError("this control cannot touch: its driver knows no probe input", "find the points there, and use `abbe import`")
    return controller


async def guarded_move(controller: Motion, target: Point, *, feed_mm_min: float, timeout_s: float) -> None:
    """Move. If a probe is fitted, move by a touch command: an abort may have left the stylus in a hole or beside a ball.

    Raises
    ------
    ProbeNotReady, Obstructed
        The stylus is deflected before the move, or met something on the way; the axes then backed off.
    """
    state = await controller.probe_state() if can_touch(controller) else None
    if state is None or not state.fitted:
        await controller.move(target, feed_mm_min=feed_mm_min, timeout_s=timeout_s)
        return
    if state.deflected:
        raise ProbeNotReady("the stylus is deflected before the first move", "free it by hand, away from the artefact; then start again")
    probe = need_probe(controller)
    start = (await probe.status()).position_mm
    latch = await probe.touch(target, feed_mm_min=feed_mm_min, timeout_s=timeout_s)
    if latch is None:
        return
    await probe.move(start, feed_mm_min=feed_mm_min, timeout_s=timeout_s)
    x, y, z = latch.position_mm
    raise Obstructed(
        f"the probe touched something at X {x:.3f} Y {y:.3f} Z {z:.3f} on its way to the artefact",
        "the axes backed off; jog the stylus clear of everything, then start again",
    )


@dataclass
class FeatureTouch:
    """One feature under the probe. ``asked``: returns whether a stop or pause is requested; ``false_trips``: trips that did not repeat."""

    probe: Probing
    step: TouchFeature
    asked: Callable[[], bool] = lambda: False
    false_trips: int = 0
    out: list[Point] = field(default_factory=list)
    """Places on the way out of the feature, to be passed from the last to the first."""
    _period_s: float = 0.0

    async def run(self) -> dict[str, Any] | None:
        """Return the record of the feature (`abbe.service.runs.touches`) without its time; None: the feature was left on request.

        Raises
        ------
        ProbeNotReady, Obstructed, MissedContact, FalseTrips, ProbeUncalibrated
            The stylus is above the feature or, if something is in the way, where it stopped.
        """
        step = self.step
        await self._ready()
        await self._rise()
        await self._protected(step.above_mm)
        touches: list[list[list[float]]] = []
        for side in step.sides:
            if touches and self.asked():
                await self._leave()
                return None
            try:
                touches.append(await self._side(side))
            except (MissedContact, FalseTrips):
                await self._leave()
                raise
            if not step.inside:
                await self._leave()
        await self._leave()
        record: dict[str, Any] = {
            "feature": step.feature, "inside": step.inside, "nominal_mm": list(step.nominal_mm), "target_mm": list(step.centre_mm),
            "sides": [list(s) for s in step.sides], "touches_mm": touches, "start_deg": step.start_deg,
            "feed_mm_min": step.touch_feed_mm_min, "resolution_mm": self._period_s * step.touch_feed_mm_min / 60.0,
            "false_trips": self.false_trips, "radius_mm": step.radius_mm, "u_sphere_mm": step.u_sphere_mm,
        }  # fmt: skip
        self._check_radius(parsed(TouchedFeature, record))
        return record

    async def _ready(self) -> None:
        state = await self.probe.probe_state()
        if not state.fitted or state.deflected:
            what = "the stylus is deflected" if state.fitted else "no touch probe is fitted and ready"
            remedy = "free it by hand, away from the artefact" if state.fitted else "fit it, look at its battery and its stylus"
            raise ProbeNotReady(f"{self.step.what}: {what}", f"{remedy}; then resume")

    async def _rise(self) -> None:
        """Rise to the clear height first: an abort may have left the stylus beside a ball or in a hole."""
        here, up = (await self.probe.status()).position_mm, self.step.up
        below = sum((a - h) * u for a, h, u in zip(self.step.above_mm, here, up, strict=True))
        if below > 0.0:
            x, y, z = (h + below * u for h, u in zip(here, up, strict=True))
            await self._protected((x, y, z))

    async def _side(self, side: Point) -> list[list[float]]:
        """Return the repeated, agreeing touches of one side."""
        step = self.step
        if step.inside and not self.out:
            await self._in((step.above_mm,), step.centre_mm)
        elif not step.inside:
            await self._in((step.above_mm, step.over_mm(side)), step.before_mm(side))
        if step.inside:
            await self._protected(step.before_mm(side))
        found: list[Point] = []
        for _ in range(step.repeats + MORE_TOUCHES):
            latch = await self._touch(step.beyond_mm(side), step.touch_feed_mm_min)
            await self._move(step.before_mm(side))
            if latch is None:
                raise MissedContact(
                    f"{step.what}: no contact within {step.search_mm:g} mm of where it was expected",
                    "check the feature, the place of the artefact and the probe's battery, then resume",
                )
            found.append(latch.position_mm)
            same = [p for p in found if math.dist(p, latch.position_mm) <= AGREE_MM]
            if len(same) >= step.repeats:
                self.false_trips, self._period_s = self.false_trips + len(found) - len(same), latch.period_s
                if step.inside:
                    await self._move(step.centre_mm)
                return [list(p) for p in same[: step.repeats]]
        raise FalseTrips(
            f"{step.what}: {len(found)} touches of one side, of which no {step.repeats} agree within {1e3 * AGREE_MM:.0f} um",
            "look at the stylus (loose, chipped), at chips on the feature and at the probe's cable or receiver; then resume",
        )

    async def _in(self, over: tuple[Point, ...], to: Point) -> None:
        """Go down to a place, and remember the way out."""
        for place in (*over[1:], to):
            await self._protected(place)
        self.out = [*over, to]

    async def _leave(self) -> None:
        """Take the stylus out the way it came in."""
        way, self.out = self.out[::-1][1:], []
        for place in way:
            await self._protected(place)

    async def _protected(self, target: Point) -> None:
        """Move where nothing may be touched. After one trip, back off and try again: the trip may have been false."""
        start = (await self.probe.status()).position_mm
        if math.dist(start, target) < SAME_PLACE_MM:
            return
        latch = await self._touch(target, self.step.feed_mm_min)
        if latch is not None:
            self.false_trips += 1
            await self._move(start)
            latch = await self._touch(target, self.step.feed_mm_min)
        if latch is None:
            return
        await self._move(start)
        x, y, z = latch.position_mm
        raise Obstructed(
            f"{self.step.what}: the probe touched something at X {x:.3f} Y {y:.3f} Z {z:.3f} on its way",
            "the axes backed off; check the artefact (turned by 90 degrees? another one? a clamp in the way?), then resume",
        )

    async def _free(self) -> None:
        """Wait until the stylus is at rest. A stylus that stays deflected is withdrawn by plain moves: touch commands do not work then."""
        for _ in range(round(RESEAT_S / POLL_S)):
            if not (await self.probe.probe_state()).deflected:
                return
            await asyncio.sleep(POLL_S)
        way, self.out = self.out[::-1][1:], []
        for place in way:
            await self._move(place)
        raise ProbeNotReady(
            f"{self.step.what}: the stylus stays deflected {RESEAT_S:g} s after a touch",
            "look at the stylus, at its seat and at the probe's receiver; then resume",
        )

    async def _touch(self, target: Point, feed_mm_min: float) -> Latch | None:
        await self._free()
        return await self.probe.touch(target, feed_mm_min=feed_mm_min, timeout_s=TOUCH_S + self._seconds(feed_mm_min))

    async def _move(self, target: Point) -> None:
        feed = self.step.feed_mm_min
        await self.probe.move(target, feed_mm_min=feed, timeout_s=TOUCH_S + self._seconds(feed))

    def _seconds(self, feed_mm_min: float) -> float:
        """Return three times the time of the longest way at this feed, as a limit that also holds for low overrides."""
        return 3.0 * 60.0 * 500.0 / feed_mm_min

    def _check_radius(self, touched: TouchedFeature) -> None:
        off = found_feature(touched).radius_mm - self.step.radius_mm
        if abs(off) > RADIUS_MM:
            what = "the radius_mm of the sphere" if touched.qualifies else "the radius_mm of the feature"
            raise ProbeUncalibrated(
                f"{touched.what}: its radius comes out {abs(off):.3f} mm too {'large' if off > 0.0 else 'small'}",
                f"qualify the stylus; correct stylus_radius_mm or {what}",
            )


def check_same(touched: TouchedFeature, earlier: Sequence[TouchedFeature]) -> None:
    """Compare a feature or sphere with its first touches in the same pose: stylus and artefact have to be as they were.

    Raises
    ------
    SetupDisturbed
        The feature has moved; or its radius has changed by more than `QUALIFIED_MM` and its uncertainty, so the stylus is no longer as
        qualified.
    """
    before = next((one for one in earlier if one.feature == touched.feature), None)
    if before is None:
        return
    then, now = found_feature(before), found_feature(touched)
    count = sum(not one.qualifies for one in earlier)
    drift, expanded = now.radius_mm - then.radius_mm, COVERAGE * math.hypot(then.u_radius_mm, now.u_radius_mm)
    if abs(drift) > QUALIFIED_MM + expanded:
        raise SetupDisturbed(
            f"{touched.what}: its radius changed by {1e3 * drift:+.1f} ± {1e3 * expanded:.1f} um "
            f"(features touched meanwhile: {count}): the stylus is no longer as it was qualified",
            f"tighten or change the stylus and qualify it; {_ANEW}",
        )
    moved = math.dist(now.centre_mm, then.centre_mm)
    if moved > MOVED_MM:
        why, remedy = (
            ("the stylus was changed or knocked, or the sphere is loose", "fasten stylus and sphere, and qualify the stylus")
            if touched.qualifies
            else ("the artefact is loose", "clamp the artefact firmly")
        )
        raise SetupDisturbed(
            f"{touched.what} moved by {1e3 * moved:.0f} um (features touched meanwhile: {count}): {why}",
            f"{remedy}; {_ANEW}",
        )
