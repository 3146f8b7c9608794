"""What was asked of effectors over time: the demand, with effectiveness, limits and weights that may change from sample to sample."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from allocation.core import Effectors
from allocation.qp import Weights, weights_for
from models.checked import Array, ModelError, as_finite, as_scalar, frozen


@dataclass(frozen=True, slots=True, eq=False)
class History:
    """What was asked for over time, and what the effectors could do then.

    Attributes
    ----------
    effectors : Effectors
        Names, axes, rates, flows; B and limits where they do not change.
    dt : float
        Sample time, s.
    demand : ndarray, shape (N, m)
    B : ndarray, shape (N, m, n), optional
    lower, upper : ndarray, shape (N, n), optional
    context : mapping of str to ndarray (N,)
        What else a method may need, such as qbar.
    axis_weight, effector_weight : ndarray, shapes (N, m), (N, n), optional
        Weights of axes and effectors for each sample; otherwise ``weights_for(effectors)`` for all.
    name : str
    """

    effectors: Effectors
    dt: float
    demand: Array
    B: Array | None = None
    lower: Array | None = None
    upper: Array | None = None
    context: Mapping[str, Array] = field(default_factory=dict)
    axis_weight: Array | None = None
    effector_weight: Array | None = None
    name: str = "demand"

    def __post_init__(self) -> None:
        m, n = self.effectors.B.shape
        demand = self.effectors.demands(self.demand)
        if demand.ndim != 2:
            raise ModelError(f"history {self.name}: demand has shape {demand.shape}, expected (N, {m})")
        if as_scalar(f"history {self.name}: dt", self.dt) <= 0:
            raise ModelError(f"history {self.name}: dt must be > 0 s, got {self.dt}")
        N = len(demand)
        object.__setattr__(self, "demand", frozen(demand))
        shapes = {"B": (N, m, n), "lower": (N, n), "upper": (N, n), "axis_weight": (N, m), "effector_weight": (N, n)}
        for what, shape in shapes.items():
            given = getattr(self, what)
            if given is None:
                continue
            values = as_finite(f"history {self.name}: {what}", given)
            if values.shape != shape:
                raise ModelError(f"history {self.name}: {what} has shape {values.shape}, expected {shape}")
            object.__setattr__(self, what, frozen(values))
        for key, column in self.context.items():
            if np.shape(column) != (N,):
                raise ModelError(f"history {self.name}: context {key} has shape {np.shape(column)}, expected ({N},)")

    def __len__(self) -> int:
        return len(self.demand)

    def __repr__(self) -> str:
        e = self.effectors
        return f"History({self.name!r}: {len(self)} samples of {self.dt:g} s, axes {e.axes}, {len(e.names)} effectors)"

    @property
    def t(self) -> Array:
        """Times of the samples, s."""
        return np.asarray(self.dt * np.arange(len(self)), dtype=float)

    def at(self, k: int) -> Effectors:
        """The effectors at sample k."""
        if self.B is None and self.lower is None and self.upper is None:
            return self.effectors
        e = self.effectors
        return replace(
            e, B=e.B if self.B is None else self.B[k], lower=e.lower if self.lower is None else self.lower[k],
            upper=e.upper if self.upper is None else self.upper[k],
        )  # fmt: skip

    def failed(self, names: Iterable[str] | Mapping[str, float | None]) -> History:
        """The same history with effectors out of order.

        Parameters and errors are those of :meth:`allocation.core.Effectors.failed`.
        """
        values = dict(names) if isinstance(names, Mapping) else dict.fromkeys(names)
        broken = self.effectors.failed(values)
        gone = [self.effectors.index(name) for name in values]

        def held(moving: Array | None, limits: Array) -> Array | None:
            if moving is None:
                return None
            changed = moving.copy()
            changed[:, gone] = limits[gone]
            return changed

        return replace(self, effectors=broken, lower=held(self.lower, broken.lower), upper=held(self.upper, broken.upper))

    def part(self, rows: np.ndarray | slice) -> History:
        """Some of the samples; rates between samples that were not neighbours lose their meaning."""

        def pick(values: Array | None) -> Array | None:
            return None if values is None else values[rows]

        return replace(
            self, demand=self.demand[rows], B=pick(self.B), lower=pick(self.lower), upper=pick(self.upper),
            context={k: v[rows] for k, v in self.context.items()}, axis_weight=pick(self.axis_weight),
            effector_weight=pick(self.effector_weight),
        )  # fmt: skip

    def weighted(
        self, *, priority: Mapping[str, float] | None = None, cost: Mapping[str, float] | None = None, ratio: float = 3e-4
    ) -> History:
        """The same history with weights from :func:`allocation.qp.weights_for` at each sample; the effectors' own limits set the scale."""
        if self.B is None:
            w = weights_for(self.effectors, priority=priority, cost=cost, ratio=ratio)
            rows = len(self)
            return replace(self, axis_weight=np.tile(w.axis, (rows, 1)), effector_weight=np.tile(w.effector, (rows, 1)))
        each = [weights_for(replace(self.effectors, B=B), priority=priority, cost=cost, ratio=ratio) for B in self.B]
        return replace(self, axis_weight=np.array([w.axis for w in each]), effector_weight=np.array([w.effector for w in each]))

    def weights_at(self, k: int) -> Weights:
        """Weights at sample k."""
        if self.axis_weight is None or self.effector_weight is None:
            return weights_for(self.effectors)
        return Weights(self.axis_weight[k], self.effector_weight[k], np.zeros(len(self.effectors.names)))
