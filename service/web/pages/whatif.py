"""What would be left if some errors were corrected: choices, numbers and bars for the screen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from abbe.models.uncertainty.what_if import Forecast, check_figures, what_if
from abbe.service.domain.results import SolutionRecord
from abbe.service.errors import AbbeError
from abbe.service.identification.solution_field import StoredField, stored_field
from abbe.service.rendering.numbers import COVERAGE, with_uncertainty
from abbe.service.rendering.plots.paired import Pair, paired_bars
from abbe.service.sequences.recipes.campaigns import hemisphere
from abbe.service.storage.store import Store
from abbe.service.web.frame import current

MEAN = "mean."
"""Before the name of a scale or squareness that is averaged over the volume."""
CHECK_PLACE, CHECK_SHARE = (0.45, 0.55, 0.12), 0.7
"""Where the shipped checks set up the ball-bar (`abbe.service.sequences.recipes.campaigns.quick_check`)."""
UM = 1e3
RESOLUTION_MM = 1e-7
"""Nobody measures a tenth of a nanometre; an uncertainty below it is rounding of numbers."""
NOTHING = Markup("")
Say = Callable[..., str]


@dataclass(frozen=True, slots=True)
class EffectChoice:
    """What can be taken as corrected.

    ``text``: its name for people; ``reason``: why it cannot be chosen alone, empty if it can; ``taken``: whether it was.
    """

    name: str
    text: str
    status: str
    reason: str
    taken: bool


@dataclass(frozen=True, slots=True)
class ForecastLine:
    """A figure in the reader's unit: value and U (k = 2) before and after, the gain, what that says: better, worse, not beyond its U."""

    name: str
    before: tuple[str, str]
    after: tuple[str, str]
    gain: tuple[str, str]
    told: str


@dataclass(frozen=True, slots=True)
class WhatIfScreen:
    """The question and its answer. ``means``: linear errors over the volume; ``trouble``: why there is no answer."""

    number: int
    campaign: str
    means: Sequence[EffectChoice] = ()
    motions: Sequence[EffectChoice] = ()
    everything: bool = False
    lines: Sequence[ForecastLine] = ()
    picture: Markup = NOTHING
    trouble: str = ""

    @property
    def taken(self) -> bool:
        """Whether anything counts as corrected."""
        return self.everything or any(c.taken for c in (*self.means, *self.motions))

    @property
    def shut(self) -> list[EffectChoice]:
        """What cannot be chosen alone."""
        return [c for c in self.motions if c.reason]


def whatif_screen(store: Store, record: SolutionRecord, take: Sequence[str], everything: bool, say: Say) -> WhatIfScreen:
    """Ask a stored solution; what it cannot answer says why."""
    campaign = store.campaigns.find(record.campaign_id).name
    try:
        stored = stored_field(store, record)
    except (AbbeError, ValueError, KeyError, TypeError) as error:
        return WhatIfScreen(record.id, campaign, trouble=error.detail if isinstance(error, AbbeError) else repr(error))
    means, motions = _means(stored, take, say), _motions(stored, take)
    why = "" if everything else _refusal([*means, *motions], take, say)
    if why:
        return WhatIfScreen(record.id, campaign, means, motions, trouble=why)
    outcomes = forecast(stored, [] if everything else take, everything=everything)
    screen = WhatIfScreen(record.id, campaign, means, motions, everything, [_line(o, say) for o in outcomes])
    if not screen.taken:
        return screen
    return WhatIfScreen(record.id, campaign, means, motions, everything, screen.lines, _picture(outcomes, say))


def forecast(stored: StoredField, take: Sequence[str], *, everything: bool = False) -> list[Forecast]:
    """Figures of the volume and of the shipped check, before and after."""
    known = stored.known
    centre, radius = hemisphere(known.machine, CHECK_PLACE, CHECK_SHARE)
    linear = {name: stored.means[name][0] for name in (t.removeprefix(MEAN) for t in take if t.startswith(MEAN))}
    motions = [name for name in take if not name.startswith(MEAN)]
    off = known.coefficients if everything else known.estimate_of(motions) + known.linear(linear)
    return what_if(known, off, check_figures(known, (np.array(centre), radius)))


def _means(stored: StoredField, take: Sequence[str], say: Say) -> list[EffectChoice]:
    """Linear errors over the volume with their values: a quantity that runs show even where they cannot tell single motions apart.

    µm/m is a ratio: the same number for a reader of inches (µin/in), and not converted.
    """
    out = []
    for name, (value, u) in stored.means.items():
        shown = "{} ± {}".format(*with_uncertainty(value * 1e6, u * 1e6)) + (" µm/m" if name[0] == "E" else " µrad")
        text = say("whatif.slope" if name[0] == "E" else "whatif.square", name=name, value=shown)
        out.append(EffectChoice(MEAN + name, text, "", "", MEAN + name in take))
    return out


def _motions(stored: StoredField, take: Sequence[str]) -> list[EffectChoice]:
    return [EffectChoice(m, m, stored.statuses.get(m, ""), stored.hidden.get(m, ""), m in take) for m in stored.motions]


def _refusal(choices: Sequence[EffectChoice], take: Sequence[str], say: Say) -> str:
    """Why the question cannot be answered, in one line; empty if it can."""
    strange = [name for name in take if name not in {c.name for c in choices}]
    if strange:
        return say("whatif.refused", names=", ".join(strange), why=say("whatif.unknown"))
    lost = [c for c in choices if c.taken and c.reason]
    if lost:
        return say("whatif.refused", names=", ".join(c.name for c in lost), why=lost[0].reason)
    twice = [name for name in take if MEAN + name in take]
    return say("whatif.twice", names=", ".join(twice)) if twice else ""


def _line(o: Forecast, say: Say) -> ForecastLine:
    pairs = [(o.before_mm, o.u_before_mm), (o.after_mm, o.u_after_mm), (o.gain_mm, max(o.u_gain_mm, RESOLUTION_MM))]
    before, after, gain = (current().with_u(v * UM, u * UM) for v, u in pairs)
    if o.u_gain_mm < RESOLUTION_MM:  # taking a given scale out shifts a range by as much in every draw: what is left is rounding
        gain = (gain[0], "0")
    sure = abs(o.gain_mm) > max(COVERAGE * o.u_gain_mm, RESOLUTION_MM)
    return ForecastLine(_name(o, say), before, after, gain, "unsure" if not sure else "better" if o.gain_mm > 0.0 else "worse")


def _name(o: Forecast, say: Say) -> str:
    stem, _, rest = o.name.partition("_")
    return say("figure.diagonal", name=rest) if stem == "diagonal" else say(f"whatif.{o.name}")


def _picture(outcomes: Sequence[Forecast], say: Say) -> Markup:
    pairs = [Pair(_name(o, say), (o.before_mm * UM, o.u_before_mm * UM), (o.after_mm * UM, o.u_after_mm * UM)) for o in outcomes]
    names = (say("whatif.before"), say("whatif.after"))
    # The SVG writer has escaped every text; escaping again would show the reader the tags.
    return Markup(paired_bars(pairs, names, key="whatif", heading=say("whatif.bars"), unit=current().drawn()))  # noqa: S704
