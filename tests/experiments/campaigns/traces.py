"""What a campaign can see, judged by the simulated machine itself: bend it along one parameter, and look whether the readings change.

Nothing of the solver is used: readings are recomputed without noise by `abbe.simulators.truth` with finite rotations, differences are
finite, set-ups are refitted with this file's own columns.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre

from abbe.models.solvers.observations import RunData
from abbe.simulators.truth.machine import Machine, rotate
from tests.experiments.campaigns.population import UNCALIBRATED_SD_MM, Case

COMPONENTS = "XYZABC"
THIN = 4
SQUARENESS = {"C0Y": (1, 0, -1.0), "B0Z": (2, 0, 1.0), "A0Z": (2, 1, -1.0)}


class Bent(Machine):
    """The true machine at fixed positions, with one more error: ``size`` (mm or rad) times the model's function called ``name``.

    The motions without it are worked out once.
    """

    def __init__(self, machine: Machine, axes_mm: np.ndarray) -> None:
        super().__init__(machine.geometry, machine.draws)
        self.axes_mm = axes_mm
        self._straight = [machine.motions(axis, axes_mm[:, axis]) for axis in range(3)]
        self._name, self._size = "", 0.0
        self.straight = self.tool_position(axes_mm), self.turned(axes_mm)

    def moved(self, name: str, size: float) -> tuple[np.ndarray, np.ndarray]:
        """Where the tool stands with that error, (n, 3) mm, and how it is turned, (n, 3) rad."""
        self._name, self._size = name, size
        return self.tool_position(self.axes_mm), self.turned(self.axes_mm)

    def motions(self, axis: int, position_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        shift, angle = (v.copy() for v in self._straight[axis])
        if self._name in SQUARENESS:
            a, component, sign = SQUARENESS[self._name]
            if a == axis:
                shift[:, component] += sign * self._size * position_mm
        elif self._name and self._name[2] == "XYZ"[axis]:
            low, high = self.geometry.low_mm[axis], self.geometry.high_mm[axis]
            order = np.eye(40)[int(self._name.partition(".")[2])]
            value = legendre.legval(2.0 * (position_mm - low) / (high - low) - 1.0, order) - legendre.legval(-1.0, order)
            component = COMPONENTS.index(self._name[1])
            (shift if component < 3 else angle)[:, component % 3] += self._size * value
        return shift, angle


@dataclass(frozen=True)
class Traces:
    """Whitened change of all readings per typical size of each parameter, set-ups refitted, shape (n, p).

    ``raw``: the same before the set-ups were refitted; ``typical``: sizes, mm or rad.
    """

    names: tuple[str, ...]
    typical: np.ndarray
    seen: np.ndarray
    raw: np.ndarray

    def share(self) -> np.ndarray:
        """1 - posterior / prior variance of each parameter if errors have typical sizes, shape (p,): 0 leaves no trace."""
        gram = self.seen.T @ self.seen
        return 1.0 - np.diag(np.linalg.inv(gram + np.eye(len(self.names))))

    def least(self, names: list[str]) -> float:
        """Smallest trace of any combination of these parameters, over what each would show by itself (unit columns); 0: hidden."""
        at = [self.names.index(n) for n in names]
        shown = np.linalg.norm(self.raw[:, at], axis=0)
        return float(np.linalg.svd(self.seen[:, at] / np.where(shown > 0, shown, 1.0), compute_uv=False)[-1])

    def hidden_basis(self, limit: float) -> np.ndarray:
        """Directions (columns, in typical sizes) that change all readings together by less than ``limit`` sigma, shape (p, q)."""
        values, vectors = np.linalg.eigh(self.seen.T @ self.seen)
        return vectors[:, values < limit**2]


def traces(case: Case, names: tuple[str, ...]) -> Traces:
    """Bend the machine along every parameter in turn; every `THIN`-th value of a bar run is looked at."""
    typical = np.array([typical_size(case, n) for n in names])
    columns, setups = [], []
    for full in case.runs:
        run = _thinned(full)
        sigma = _sigma(case, run)
        columns.append(_changes(case, run, names, typical) / sigma[:, None])
        setups.append({k: v / sigma for k, v in _setup_columns(run).items()})
    raw = np.concatenate(columns)
    nuisance = _stack(setups, [len(c) for c in columns], _known(case))
    padded = np.concatenate([raw, np.zeros((len(nuisance) - len(raw), len(names)))])
    u, s, _ = np.linalg.svd(nuisance / np.linalg.norm(nuisance, axis=0), full_matrices=False)
    basis = u[:, s > 1e-9 * s[0]]
    return Traces(names, typical, padded - basis @ (basis.T @ padded), raw)


def typical_size(case: Case, name: str) -> float:
    """Typical size of a parameter in the population, mm or rad."""
    sizes, geometry = case.truth.rig.scenario.magnitudes, case.truth.rig.geometry
    if name in SQUARENESS:
        return sizes.squareness_sd_urad * 1e-6
    if name.startswith("backlash"):
        return float(np.mean(sizes.backlash_um)) * 1e-3
    motion, _, k = name.partition(".")
    axis, component, order = "XYZ".index(motion[2]), COMPONENTS.index(motion[1]), int(k)
    fade = 1.0 / (1.0 + (order / 4.0) ** 2)
    if component >= 3:
        return (sizes.angle_slope_sd_urad / 2 if order == 1 else float(np.mean(sizes.angle_rms_urad)) * fade) * 1e-6
    if component == axis:
        span = float(geometry.high_mm[axis] - geometry.low_mm[axis])
        return sizes.scale_sd_um_per_m * 1e-6 * span / 2 if order == 1 else float(np.mean(sizes.positioning_rms_um)) * 1e-3 * fade
    return float(np.mean(sizes.straightness_rms_um)) * 1e-3 * fade


def _thinned(run: RunData) -> RunData:
    if run.kind == "laser":
        return run
    picked = {k: getattr(run, k)[::THIN] for k in ("axes_mm", "deviation_mm", "sign", "t_s")}
    return replace(run, weight_n=THIN * run.weight_n[::THIN], **picked)


def _changes(case: Case, run: RunData, names: tuple[str, ...], sizes: np.ndarray) -> np.ndarray:
    """Change of the readings of a run for each parameter, shape (n, p), mm."""
    machine, lost = case.truth.rig.machine(run.tool_mm), case.truth.rig.draws.backlash_mm
    stands = run.axes_mm - 0.5 * run.sign * lost
    bent = Bent(machine, stands)
    cup = machine.tool_position(run.centre_mm[None])[0] if run.kind == "bar" else None

    def reading(where: np.ndarray, turned: np.ndarray) -> np.ndarray:
        if cup is not None:
            return np.linalg.norm(where - cup, axis=1)
        mirror = rotate(turned, np.tile(run.beam, (len(where), 1)))
        return np.einsum("ij,ij->i", where - where[0], mirror) / (mirror @ run.beam)

    base, out = reading(*bent.straight), []
    for name, size in zip(names, sizes, strict=True):
        if name.startswith("backlash"):
            at = stands - 0.5 * size * run.sign * np.eye(3)["XYZ".index(name[-1])]
            out.append(reading(machine.tool_position(at), machine.turned(at)))
        else:
            out.append(reading(*bent.moved(name, float(size))))
    return np.stack(out, axis=1) - base[:, None]


def _sigma(case: Case, run: RunData) -> np.ndarray:
    c = case.truth.rig.conditions
    return (c.bar_noise_mm if run.kind == "bar" else c.laser_noise_mm) / np.sqrt(run.weight_n)


def _setup_columns(run: RunData) -> dict[str, np.ndarray]:
    n = len(run.axes_mm)
    if run.kind == "bar":
        d = run.axes_mm - run.centre_mm
        d = d / np.linalg.norm(d, axis=1, keepdims=True)
        return {f"cup {run.setup} {k}": d[:, k] for k in range(3)} | {f"length {run.radius_mm:g}": np.ones(n)}
    d = run.axes_mm - run.axes_mm[0]
    along = d @ run.beam
    across = d - np.outer(along, run.beam)
    names = {f"tilt {run.setup} {k}": across[:, k] for k in range(3) if np.abs(across[:, k]).max() > 1e-6}
    return names | {f"zero {run.label}": np.ones(n), f"drift {run.label}": run.t_s - run.t_s[0], "wavelength": along}


def _known(case: Case) -> dict[str, float]:
    """Set-up unknowns that come with a statement: standard deviation."""
    known = {"wavelength": case.truth.rig.conditions.wavelength_sd}
    for run in case.runs:
        if run.kind == "bar":
            known[f"length {run.radius_mm:g}"] = run.u_length_mm if run.length_calibrated else UNCALIBRATED_SD_MM
    return known


def _stack(setups: list[dict[str, np.ndarray]], sizes: list[int], known: dict[str, float]) -> np.ndarray:
    names = list(dict.fromkeys(n for s in setups for n in s))
    told = [n for n in names if n in known]
    out = np.zeros((sum(sizes) + len(told), len(names)))
    row = 0
    for setup, n in zip(setups, sizes, strict=True):
        for name, column in setup.items():
            out[row : row + n, names.index(name)] = column
        row += n
    for k, name in enumerate(told):
        out[row + k, names.index(name)] = 1.0 / known[name]
    return out
