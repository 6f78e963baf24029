"""The what-if screen: errors that would remain if some error motions were corrected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from abbe.models.uncertainty.what_if import GainForecast, check_figures, what_if
from abbe.service.domain.results import SolutionRecord
from abbe.service.errors import AbbeError
from abbe.service.identification.solution_field import StoredField, stored_field
from abbe.service.rendering.numbers import COVERAGE, with_uncertainty
from abbe.service.rendering.plots.bars import Pair, paired_bars
from abbe.service.sequences.recipes.campaigns import hemisphere
from abbe.service.storage.store import Store
from abbe.service.web.frame import current
from abbe.service.web.language import Translate

MEAN = "mean."
"""Prefix of scales and squarenesses that are averaged over the volume."""
CHECK_PLACE, CHECK_SHARE = (0.45, 0.55, 0.12), 0.7
"""Set-up of the ball-bar in the builtin checks (`abbe.service.sequences.recipes.campaigns.quick_check`)."""
UM = 1e3
RESOLUTION_MM = 1e-7
"""Uncertainties below a tenth of a nanometre are rounding."""
NOTHING = Markup("")


@dataclass(frozen=True, slots=True)
class EffectChoice:
    """An error that a person can take as corrected.

    ``text``: name for people; ``reason``: why it cannot be chosen alone, empty if it can; ``selected``: whether it is taken as corrected.
    """

    name: str
    text: str
    status: str
    reason: str
    selected: bool


@dataclass(frozen=True, slots=True)
class ForecastLine:
    """A figure in the reader's unit: value and U (k = 2) before and after, the gain, and its verdict: better, worse, unsure."""

    name: str
    before: tuple[str, str]
    after: tuple[str, str]
    gain: tuple[str, str]
    verdict: str


@dataclass(frozen=True, slots=True)
class WhatIfScreen:
    """Selection and forecast. ``means``: mean linear errors over the volume; ``trouble``: why there is no forecast."""

    number: int
    campaign: str
    means: Sequence[EffectChoice] = ()
    motions: Sequence[EffectChoice] = ()
    everything: bool = False
    lines: Sequence[ForecastLine] = ()
    picture: Markup = NOTHING
    trouble: str = ""

    @property
    def any_selected(self) -> bool:
        """Whether any error is taken as corrected."""
        return self.everything or any(c.selected for c in (*self.means, *self.motions))

    @property
    def unavailable(self) -> list[EffectChoice]:
        """Motions that cannot be chosen alone."""
        return [c for c in self.motions if c.reason]


def whatif_screen(store: Store, record: SolutionRecord, take: Sequence[str], everything: bool, translate: Translate) -> WhatIfScreen:
    """The forecast of a stored solution; ``trouble`` if there is none."""
    campaign = store.campaigns.find(record.campaign_id).name
    try:
        stored = stored_field(store, record)
    except (AbbeError, ValueError, KeyError, TypeError) as error:
        return WhatIfScreen(record.id, campaign, trouble=error.detail if isinstance(error, AbbeError) else repr(error))
    means, motions = _means(stored, take, translate), _motions(stored, take)
    why = "" if everything else _refusal([*means, *motions], take, translate)
    if why:
        return WhatIfScreen(record.id, campaign, means, motions, trouble=why)
    outcomes = forecast(stored, [] if everything else take, everything=everything)
    screen = WhatIfScreen(record.id, campaign, means, motions, everything, [_line(o, translate) for o in outcomes])
    if not screen.any_selected:
        return screen
    return WhatIfScreen(record.id, campaign, means, motions, everything, screen.lines, _picture(outcomes, translate))


def forecast(stored: StoredField, take: Sequence[str], *, everything: bool = False) -> list[GainForecast]:
    """Figures of the volume and of the builtin check, before and after the errors in ``take`` (or all) are corrected."""
    known = stored.known
    centre, radius = hemisphere(known.machine, CHECK_PLACE, CHECK_SHARE)
    linear = {name: stored.means[name][0] for name in (t.removeprefix(MEAN) for t in take if t.startswith(MEAN))}
    motions = [name for name in take if not name.startswith(MEAN)]
    off = known.coefficients if everything else known.estimate_of(motions) + known.linear(linear)
    return what_if(known, off, check_figures(known, (np.array(centre), radius)))


def _means(stored: StoredField, take: Sequence[str], translate: Translate) -> list[EffectChoice]:
    """Mean linear errors over the volume with their values; runs show them even if they cannot separate the motions.

    µm/m is a ratio with the same value in µin/in, so it is not converted.
    """
    out = []
    for name, (value, u) in stored.means.items():
        shown = "{} ± {}".format(*with_uncertainty(value * 1e6, u * 1e6)) + (" µm/m" if name[0] == "E" else " µrad")
        text = translate("whatif.slope" if name[0] == "E" else "whatif.square", name=name, value=shown)
        out.append(EffectChoice(MEAN + name, text, "", "", MEAN + name in take))
    return out


def _motions(stored: StoredField, take: Sequence[str]) -> list[EffectChoice]:
    return [EffectChoice(m, m, stored.statuses.get(m, ""), stored.hidden.get(m, ""), m in take) for m in stored.motions]


def _refusal(choices: Sequence[EffectChoice], take: Sequence[str], translate: Translate) -> str:
    """Return the reason why the selection has no forecast, in one line; empty if it has one."""
    unknown = [name for name in take if name not in {c.name for c in choices}]
    if unknown:
        return translate("whatif.refused", names=", ".join(unknown), why=translate("whatif.unknown"))
    hidden = [c for c in choices if c.selected and c.reason]
    if hidden:
        return translate("whatif.refused", names=", ".join(c.name for c in hidden), why=hidden[0].reason)
    twice = [name for name in take if MEAN + name in take]
    return translate("whatif.twice", names=", ".join(twice)) if twice else ""


def _line(o: GainForecast, translate: Translate) -> ForecastLine:
    pairs = [(o.before_mm, o.u_before_mm), (o.after_mm, o.u_after_mm), (o.gain_mm, max(o.u_gain_mm, RESOLUTION_MM))]
    before, after, gain = (current().with_u(v * UM, u * UM) for v, u in pairs)
    if o.u_gain_mm < RESOLUTION_MM:  # removing a given scale shifts a range equally in every draw: the rest is rounding
        gain = (gain[0], "0")
    sure = abs(o.gain_mm) > max(COVERAGE * o.u_gain_mm, RESOLUTION_MM)
    return ForecastLine(_name(o, translate), before, after, gain, "unsure" if not sure else "better" if o.gain_mm > 0.0 else "worse")


def _name(o: GainForecast, translate: Translate) -> str:
    stem, _, rest = o.name.partition("_")
    return translate("figure.diagonal", name=rest) if stem == "diagonal" else translate(f"whatif.{o.name}")


def _picture(outcomes: Sequence[GainForecast], translate: Translate) -> Markup:
    pairs = [Pair(_name(o, translate), (o.before_mm * UM, o.u_before_mm * UM), (o.after_mm * UM, o.u_after_mm * UM)) for o in outcomes]
    names = (translate("whatif.before"), translate("whatif.after"))
    # The SVG writer has already escaped every text.
    return Markup(paired_bars(pairs, names, key="whatif", heading=translate("whatif.bars"), unit=current().drawn()))  # noqa: S704
