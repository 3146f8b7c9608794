"""Sets of thrusters: where they stand, what they push, how long and with what; force and moment about any centre of mass."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from ruamel.yaml import YAML

from models.checked import Array, ModelError, as_finite, as_scalar, frozen, unknown_name
from models.units import G0, INCH

AXES = ("Fx", "Fy", "Fz", "L", "M", "N")  # force N, moment N m; x forward, y right, z down


@dataclass(frozen=True, slots=True, eq=False)
class ThrusterSet:
    """Thrusters on one body; body axes x forward, y right, z down.

    Attributes
    ----------
    names : tuple of str, length n
    position : ndarray, shape (n, 3)
        From the reference point to the thrust's point of attack, m.
    direction : ndarray, shape (n, 3)
        Unit vectors of the force on the vehicle.
    thrust : ndarray, shape (n,)
        N.
    t_on_min : ndarray, shape (n,)
        Shortest commanded pulse, s.
    delay_on, delay_off : ndarray, shape (n,)
        From command to thrust, and from the end of the command to its end, s.
    isp : ndarray, shape (n,)
        Specific impulse, s.
    manifold, kind : tuple of str, length n
        Common valve, and type ("primary", "vernier").
    source : str

    Raises
    ------
    ModelError
        Shapes that do not agree, a direction that is not of unit length, a thrust or impulse that is not positive.
    """

    names: tuple[str, ...]
    position: Array
    direction: Array
    thrust: Array
    t_on_min: Array
    delay_on: Array
    delay_off: Array
    isp: Array
    manifold: tuple[str, ...]
    kind: tuple[str, ...]
    source: str = ""

    def __post_init__(self) -> None:
        names = tuple(str(name) for name in self.names)
        n = len(names)
        if not n or len(set(names)) != n:
            raise ModelError(f"ThrusterSet: expected at least one thruster and different names, got {names}")
        object.__setattr__(self, "names", names)
        shapes = {"position": (n, 3), "direction": (n, 3)} | dict.fromkeys(("thrust", "t_on_min", "delay_on", "delay_off", "isp"), (n,))
        for field, shape in shapes.items():
            values = as_finite(f"ThrusterSet: {field}", getattr(self, field))
            if values.ndim == 0 and len(shape) == 1:
                values = np.full(n, float(values))
            if values.shape != shape:
                raise ModelError(f"ThrusterSet: {field} has shape {values.shape}, expected {shape}: one row for each thruster")
            object.__setattr__(self, field, frozen(values))
        for field in ("manifold", "kind"):
            entries = tuple(str(v) for v in getattr(self, field))
            if len(entries) != n:
                raise ModelError(f"ThrusterSet: {len(entries)} entries of {field} for {n} thrusters; give one for each")
            object.__setattr__(self, field, entries)
        length = np.linalg.norm(self.direction, axis=1)
        for i, name in enumerate(names):
            if abs(length[i] - 1) > 1e-6:
                raise ModelError(f"ThrusterSet: {name}: direction has length {length[i]:.7g}, expected 1; normalize it")
            if self.thrust[i] <= 0 or self.isp[i] <= 0:
                raise ModelError(f"ThrusterSet: {name}: thrust {self.thrust[i]:.6g} N and isp {self.isp[i]:.6g} s must be > 0")
            if min(self.t_on_min[i], self.delay_on[i], self.delay_off[i]) < 0:
                raise ModelError(f"ThrusterSet: {name}: a time is negative; give t_on_min and delays >= 0")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def force(self) -> Array:
        """Force of each thruster at full thrust, shape (n, 3), N."""
        return self.thrust[:, None] * self.direction

    @property
    def flow(self) -> Array:
        """Propellant of each thruster while it fires, thrust / (isp g0), shape (n,), kg/s."""
        return self.thrust / (self.isp * G0)

    def effectiveness(self, cg: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Force and moment of each thruster at full thrust about a centre of mass.

        Parameters
        ----------
        cg : array_like, shape (3,)
            From the reference point, body axes, m.

        Returns
        -------
        ndarray, shape (6, n)
            Rows ``AXES``: Fx, Fy, Fz (N) and L, M, N = (position - cg) x force (N m).
        """
        centre = as_finite("effectiveness: cg", cg)
        if centre.shape != (3,):
            raise ModelError(f"effectiveness: cg: expected 3 numbers (m from the reference point), got shape {centre.shape}")
        return np.vstack([self.force.T, np.cross(self.position - centre, self.force).T])

    def rank(self, cg: ArrayLike = (0.0, 0.0, 0.0), *, axes: Sequence[str] = AXES) -> int:
        """Number of independent axes that the set can reach (either sign); moments are compared with forces by the largest arm."""
        B = self.effectiveness(cg)
        arm = max(float(np.linalg.norm(self.position - np.asarray(cg, dtype=float), axis=1).max()), 1e-12)
        B = B / np.array([1.0, 1.0, 1.0, arm, arm, arm])[:, None] / float(self.thrust.max())
        return int(np.linalg.matrix_rank(B[[_axis(a) for a in axes]], tol=1e-9 * np.sqrt(len(self))))

    def mirrored(self) -> dict[str, str]:
        """Name of the mirror image of each thruster (y -> -y; itself in the plane of symmetry).

        Raises
        ------
        ModelError
            Names the first thruster without one, to 1e-6 in position, direction and thrust, relative.
        """
        flip = np.array([1.0, -1.0, 1.0])
        size = max(float(np.abs(self.position).max()), 1e-12)
        rows = np.hstack([self.position / size, self.direction, (self.thrust / self.thrust.max())[:, None]])
        images = np.hstack([self.position * flip / size, self.direction * flip, (self.thrust / self.thrust.max())[:, None]])
        found = {}
        for i, name in enumerate(self.names):
            distance = np.abs(rows - images[i]).max(axis=1)
            j = int(np.argmin(distance))
            if distance[j] > 1e-6:
                raise ModelError(
                    f"ThrusterSet: {name} has no mirror image; the nearest, {self.names[j]}, differs by {distance[j]:.3g} (relative)"
                )
            found[name] = self.names[j]
        return found

    def pick(self, names: Iterable[str]) -> ThrusterSet:
        """The thrusters of these names, in this order."""
        chosen = list(names)
        for name in chosen:
            if name not in self.names:
                raise ModelError(unknown_name("thruster", name, self.names))
        return self._rows([self.names.index(name) for name in chosen])

    def without(self, names: Iterable[str] = (), *, manifolds: Iterable[str] = ()) -> ThrusterSet:
        """The set without failed thrusters and without whatever hangs on failed manifolds."""
        gone, lines = set(names), set(manifolds)
        for name in gone:
            if name not in self.names:
                raise ModelError(unknown_name("thruster", name, self.names))
        for line in lines:
            if line not in self.manifold:
                raise ModelError(unknown_name("manifold", line, self.manifold))
        return self._rows([i for i, name in enumerate(self.names) if name not in gone and self.manifold[i] not in lines])

    def _rows(self, rows: list[int]) -> ThrusterSet:
        return replace(
            self, names=tuple(self.names[i] for i in rows), manifold=tuple(self.manifold[i] for i in rows),
            kind=tuple(self.kind[i] for i in rows),
            **{f: getattr(self, f)[rows] for f in ("position", "direction", "thrust", "t_on_min", "delay_on", "delay_off", "isp")},
        )  # fmt: skip


def _axis(name: str) -> int:
    if name not in AXES:
        raise ModelError(unknown_name("axis", name, AXES))
    return AXES.index(name)


@lru_cache(maxsize=1)
def orbiter_jets() -> ThrusterSet:
    """The 44 jets of the Space Shuttle orbiter: 38 primary, 6 vernier; positions from the moment reference.

    Delays are zero: the data has none.  Vacuum thrust, no impingement of plumes on the surfaces.

    Source: ``models/data/shuttle_rcs.yaml``, whose head names the documents and the corrections.
    """
    text = (resources.files("models") / "data" / "shuttle_rcs.yaml").read_text(encoding="utf-8")
    data: dict[str, Any] = YAML(typ="safe").load(text)
    jets, kinds = data["thrusters"], data["performance"]
    reference = np.array([data["reference_cg"][k] for k in ("Xo_in", "Yo_in", "Zo_in")], dtype=float)
    structural = np.array([jet["structural_in"] for jet in jets], dtype=float)
    position = INCH * (structural - reference) * np.array([-1.0, 1.0, -1.0])  # the structural frame runs aft, right, up
    direction = np.array([jet["direction"] for jet in jets], dtype=float)
    each = {key: np.array([kinds[jet["type"]][key] for jet in jets], dtype=float) for key in ("min_pulse_s", "isp_s")}
    zero = np.zeros(len(jets))
    return ThrusterSet(
        names=tuple(jet["name"] for jet in jets), position=position,
        direction=direction / np.linalg.norm(direction, axis=1, keepdims=True),  # printed with seven digits
        thrust=np.array([jet["thrust_N"] for jet in jets], dtype=float), t_on_min=each["min_pulse_s"], delay_on=zero, delay_off=zero,
        isp=each["isp_s"], manifold=tuple(jet["manifold"] for jet in jets), kind=tuple(jet["type"] for jet in jets),
        source="models/data/shuttle_rcs.yaml",
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """Moments of control surfaces per radian at one flight condition, with their limits.

    Attributes
    ----------
    names : tuple of str, length n
    moments : ndarray, shape (3, n)
        dL, dM, dN / d delta, N m/rad.
    lower, upper : ndarray, shape (n,)
        rad.
    rate : ndarray, shape (n,)
        rad/s.
    """

    names: tuple[str, ...]
    moments: Array
    lower: Array
    upper: Array
    rate: Array


def elevons_and_flap(
    *, qbar: float, area: float, chord: float, Cm_elevon: float, Cm_flap: float, CN_elevon: float, arm: float,
    elevon: tuple[float, float], flap: tuple[float, float], rates: tuple[float, float], CA_elevon: float = 0.0,
) -> Surfaces:  # fmt: skip
    """Left and right elevon and body flap as three effectors on three axes.

    Half of the symmetric elevon's pitching moment and normal force belongs to each side; with the force at the distance `arm` from the
    plane of symmetry they roll (L = +-CN qbar S arm / 2) and, by the axial force, yaw (N = +-CA qbar S arm / 2).

    Parameters
    ----------
    qbar, area, chord : float
        Pa, m2, m.
    Cm_elevon, Cm_flap : float
        dCm/d delta of both elevons together and of the flap, 1/rad.
    CN_elevon, CA_elevon : float
        d/d delta of normal (upwards positive) and axial (aft positive) force coefficient of both elevons together, 1/rad.
    arm : float
        Lateral distance of the centre of one elevon's force, m.
    elevon, flap : (lower, upper), rad
    rates : (elevon, flap), rad/s

    Notes
    -----
    An estimate: no interaction of the sides, no sideslip.  The roll by one elevon is what strip theory gives.
    """
    q = as_scalar("elevons_and_flap: qbar", qbar)
    if q < 0 or area <= 0 or chord <= 0:
        raise ModelError(f"elevons_and_flap: qbar {qbar}, area {area}, chord {chord}: expected qbar >= 0 and sizes > 0")
    half = 0.5 * q * area
    pitch, roll, yaw = half * chord * Cm_elevon, half * CN_elevon * arm, half * CA_elevon * arm
    # left (y < 0): an upward force on the left rolls right wing down (L > 0); an aft force on the left yaws nose left (N < 0)
    moments = np.array([[roll, -roll, 0.0], [pitch, pitch, q * area * chord * Cm_flap], [-yaw, yaw, 0.0]])
    low, high = np.array([elevon[0], elevon[0], flap[0]]), np.array([elevon[1], elevon[1], flap[1]])
    return Surfaces(
        ("elevon_left", "elevon_right", "body_flap"), frozen(as_finite("elevons_and_flap", moments)), frozen(low), frozen(high),
        frozen(np.array([rates[0], rates[0], rates[1]])),
    )  # fmt: skip
