"""A plate of holes or balls: its true form, expansion and bends, and its pose on the table.

Only one length of the plate is calibrated: its form and bends are unknown to the product. The plate fills the half space below its
top, z = 0 of its own axes; holes go through the plate, balls stand on it.
"""

from dataclasses import dataclass

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.scenario import ArtefactConfig
from abbe.simulators.truth.draws import UM, generator

STREAM_FORM, STREAM_MOUNTING = 20, 21
REFERENCE_C = 20.0
HOLES, BALLS = "hole_plate", "ball_plate"
BALL_HEIGHT_MM = 25.0
"""Centre of a ball above the plate that carries it."""


@dataclass(frozen=True, slots=True)
class Plate:
    """The plate at 20 °C: ids and nominal places (n, 3), deviation of the true places (n, 3), radius of each hole or ball."""

    kind: str
    ids: tuple[str, ...]
    nominal_mm: F
    form_mm: F
    radius_mm: float
    expansion_per_k: float
    thickness_mm: float = 25.0

    def document(self, u_length_mm: float) -> dict[str, object]:
        """Return the known facts: nominal places, and one certified length between the first and the last feature of the first row."""
        ends = [k for k, name in enumerate(self.ids) if name.endswith("1")]
        one, two = ends[0], ends[-1]
        true = self.nominal_mm + self.form_mm
        sensed = "xy" if self.kind == HOLES else "xyz"
        features = [
            {"id": name, "nominal_mm": place.tolist(), "sensed": sensed, "radius_mm": self.radius_mm}
            for name, place in zip(self.ids, self.nominal_mm, strict=True)
        ]
        length = {
            "from": self.ids[one], "to": self.ids[two], "length_mm": round(float(np.linalg.norm(true[two] - true[one])), 5),
            "U_mm": u_length_mm, "k": 2, "temperature_C": REFERENCE_C,
        }  # fmt: skip
        return {"kind": self.kind, "features": features, "expansion_per_K": self.expansion_per_k, "calibrated_lengths": [length]}


def draw_plate(config: ArtefactConfig, seed: int) -> Plate:
    """Draw the true plate of a scenario."""
    rng = generator(seed, STREAM_FORM)
    at = [(i, j) for j in range(config.rows) for i in range(config.columns)]
    ids = tuple(f"{chr(ord('A') + i)}{j + 1}" for i, j in at)
    height = BALL_HEIGHT_MM if config.kind == BALLS else 0.0
    nominal = np.array([[i * config.pitch_mm, j * config.pitch_mm, height] for i, j in at])
    form = config.form_um * UM * rng.standard_normal(nominal.shape)
    if config.kind == HOLES:
        form[:, 2] = 0.0
    return Plate(config.kind, ids, nominal, form, config.radius_mm, config.expansion_ppm * 1e-6)


@dataclass(frozen=True, slots=True)
class Mounting:
    """How the plate lies: ``origin_mm`` (3,) and axes ``matrix`` (3, 3) in workpiece coordinates, valid at the time ``since_s``.

    ``drift_mm_s``: velocity of the origin, shape (3,); ``bend_mm``: shift of x and of y by the clamps, as coefficients of x², xy and y²,
    where x and y are in units of 100 mm, shape (2, 3).
    """

    origin_mm: F
    matrix: F
    since_s: float
    drift_mm_s: F
    bend_mm: F


def draw_mounting(config: ArtefactConfig, seed: int, number: int, pose: tuple[F, F], since_s: float) -> Mounting:
    """Put the plate down as a person does: a few tenths of a millimetre and of a milliradian off the stated pose, clamped by hand."""
    rng = generator(seed, STREAM_MOUNTING, number)
    origin, matrix = pose
    shift = np.array([0.15, 0.15, 0.02]) * rng.standard_normal(3)
    turn = np.array([5e-5, 5e-5, 4e-4]) * rng.standard_normal(3)
    skew = np.array([[0.0, -turn[2], turn[1]], [turn[2], 0.0, -turn[0]], [-turn[1], turn[0], 0.0]])
    left, _, right = np.linalg.svd(np.eye(3) + skew)  # the nearest rotation
    drift = config.drift_um_per_h * UM / 3600.0 * rng.standard_normal(3)
    return Mounting(origin + shift, left @ right @ matrix, since_s, drift, config.clamping_um * UM * rng.standard_normal((2, 3)))


def placed(body: Plate, mounting: Mounting, time_s: float, temperature_c: float) -> F:
    """Return the true centres of all features in workpiece coordinates, (n, 3) mm."""
    true = body.nominal_mm + body.form_mm
    u, v = true[:, 0] / 100.0, true[:, 1] / 100.0
    bend = np.stack([u * u, u * v, v * v], axis=1) @ mounting.bend_mm.T
    own = true * (1.0 + body.expansion_per_k * (temperature_c - REFERENCE_C))
    own[:, :2] += bend
    lies: F = mounting.origin_mm + mounting.drift_mm_s * (time_s - mounting.since_s) + own @ mounting.matrix.T
    return lies


def clearance(body: Plate, mounting: Mounting, centres_mm: F, at_mm: F, radius_mm: float) -> F:
    """Return the distance, mm, of a sphere of this radius from the material, at n places (workpiece coordinates, mm); negative: inside."""
    own = (at_mm - mounting.origin_mm) @ mounting.matrix
    features = (centres_mm - mounting.origin_mm) @ mounting.matrix
    above = own[:, 2] - radius_mm
    if body.kind == BALLS:
        away = np.linalg.norm(own[:, None, :] - features[None, :, :], axis=2).min(axis=1)
        free: F = np.minimum(away - body.radius_mm - radius_mm, above)
        return free
    away = np.linalg.norm(own[:, None, :2] - features[None, :, :2], axis=2).min(axis=1)
    in_hole = np.minimum(body.radius_mm - away - radius_mm, own[:, 2] + body.thickness_mm)
    free = np.maximum(above, in_hole)
    return free
