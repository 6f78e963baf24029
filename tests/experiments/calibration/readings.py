"""What ball-bar and laser show of a true machine in imperfect set-ups, with noise (docs/explanation/conventions.md, "Readings")."""

from dataclasses import dataclass, field

import numpy as np

from tests.experiments.calibration.curves import Rng
from tests.experiments.calibration.kinematics import F, TrueMachine
from tests.experiments.calibration.plan import Step

SLOW_SHARE, SLOW_STEP = 0.1, 0.85
"""Share of the variance of the noise that is an AR(1) process, and its correlation from reading to reading."""


@dataclass(frozen=True)
class Noise:
    """Noise of the instruments, µm. ``spread``: factor between the quietest and the loudest run, 1 = all alike."""

    bar_um: float
    laser_um: float
    kind: str = "slow"
    spread: float = 1.0
    outliers: float = 0.0
    bar_step_um: float = 0.1
    laser_step_um: float = 0.01

    def draw(self, rng: Rng, n: int, *, bar: bool) -> F:
        """Noise of one run of n readings, µm."""
        size = (self.bar_um if bar else self.laser_um) * self.spread ** rng.uniform(-0.5, 0.5)
        white = rng.standard_normal(n)
        if self.kind == "pink":
            out = size * (0.95 * _one_over_f(rng, n) + 0.3 * white)
        elif self.kind == "slow":
            out = size * (np.sqrt(1.0 - SLOW_SHARE) * white + np.sqrt(SLOW_SHARE) * _first_order(rng, n))
        else:
            out = size * white
        wrong = rng.random(n) < self.outliers
        return out + wrong * rng.choice([-1.0, 1.0], n) * rng.uniform(3.0, 40.0, n)


@dataclass
class Setups:
    """Errors of the mountings, drawn when a set-up is first used: cups 2 to 30 µm, bars 1.5 µm, mirrors and beams up to 300 µrad."""

    rng: Rng
    cup_um: float = 10.0
    cups: dict[str, F] = field(default_factory=dict)
    bars: dict[float, float] = field(default_factory=dict)
    mirrors: dict[str, tuple[F, F]] = field(default_factory=dict)

    def cup_mm(self, setup: str) -> F:
        """Cup minus where the machine set it down."""
        if setup not in self.cups:
            self.cups[setup] = 1e-3 * self.cup_um * self.rng.standard_normal(3) / np.sqrt(3.0)
        return self.cups[setup]

    def bar_mm(self, radius_mm: float) -> float:
        """What a reading of this bar is too long by."""
        return self.bars.setdefault(radius_mm, 1.5e-3 * float(self.rng.standard_normal()))

    def mirror(self, setup: str, beam: F) -> tuple[F, F]:
        """Mirror's normal times beam is one, and the beam's direction: both somewhat off the nominal beam."""
        if setup not in self.mirrors:
            across = np.linalg.svd(beam[None])[2][1:]
            tilt, lean = self.rng.uniform(-300e-6, 300e-6, (2, 2)) / np.sqrt(2.0)
            self.mirrors[setup] = beam + tilt @ across, (beam + lean @ across) / np.linalg.norm(beam + lean @ across)
        return self.mirrors[setup]


def reading_mm(machine: TrueMachine, step: Step, setups: Setups) -> F:
    """Readings of a run without noise, shape (n,), mm: length minus radius, or displacement minus nominal."""
    off = machine.deviation_mm(step.axes_mm, step.sign, step.t_s)
    name = step.setup["setup_id"]
    if step.is_bar:
        centre, radius = np.array(step.setup["centre_mm"]), float(step.setup["radius_mm"])
        placed = machine.deviation_mm(centre[None], t_s=np.array([step.setup["t_set_s"]]))[0] + setups.cup_mm(name)
        arm = step.axes_mm - centre
        out: F = np.linalg.norm(arm + off - placed, axis=1) - radius + setups.bar_mm(radius)
        return out
    beam = np.array(step.setup["nominal_beam"])
    normal, real = setups.mirror(name, beam)
    moved, off = step.axes_mm - step.axes_mm[0], off - off[0]
    turned = machine.mirror(step.axes_mm, normal)
    out = np.einsum("ni,ni->n", moved + off, turned) / (turned @ real) - moved @ beam
    return out


def shown_mm(machine: TrueMachine, step: Step, setups: Setups, noise: Noise, rng: Rng) -> F:
    """What the instrument shows and the run holds, mm."""
    noisy = 1e3 * reading_mm(machine, step, setups) + noise.draw(rng, len(step.t_s), bar=step.is_bar)
    unit = noise.bar_step_um if step.is_bar else noise.laser_step_um
    return np.round(1e-3 * (np.round(noisy / unit) * unit if unit else noisy), 8)


def _first_order(rng: Rng, n: int) -> F:
    """AR(1) of unit variance."""
    out = rng.standard_normal(n)
    for k in range(1, n):
        out[k] = SLOW_STEP * out[k - 1] + np.sqrt(1.0 - SLOW_STEP**2) * out[k]
    return out


def _one_over_f(rng: Rng, n: int) -> F:
    """1/f noise of unit variance over the run, without mean."""
    k = np.arange(n // 2 + 1)
    spectrum = rng.standard_normal((2, k.size)) / np.sqrt(np.maximum(k, 1))
    out = np.fft.irfft((spectrum[0] + 1j * spectrum[1]) * (k > 0), n)
    return out / out.std()
