"""Entries by diffrax: Dormand and Prince's method of order 8 with an event at the stop, cases in vectors (vmap), compiled by JAX."""

from __future__ import annotations

import os
import types
from collections.abc import Callable
from typing import Any

# JAX reads this when it first computes: one device for each processor
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={os.cpu_count() or 1}"

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix

jax.config.update("jax_enable_x64", True)

Array = np.ndarray
VECTOR = 256  # cases in a vector, which ends with its slowest case; of 64 to 10000, measured


def with_jax(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same formulas on JAX's numbers: `math` means `jax.numpy`."""
    return types.FunctionType(function.__code__, {**function.__globals__, "math": jnp})


def kernel(
    rate: Callable[..., Any], altitude: Callable[..., float], stop: float, *, adaptive: bool = False, vector: int = VECTOR
) -> Callable[[Array, Array, float, float], Array]:
    """(y0 (N, 6), (kd, kl) (N, 2), step s, t_max s) -> states at the stop altitude (N, 6); NaN where it is not reached.

    In place of the step, adaptive ones (measured: slower at equal accuracy) take a relative tolerance.
    """
    flow, height = with_jax(rate), with_jax(altitude)
    event = diffrax.Event(lambda t, y, args, **_: height(*y[:3]) - stop, optimistix.Bisection(1e-13, 1e-9, flip="detect"))

    def one(y0: Any, k: Any, setting: Any, t_max: Any) -> Any:
        control: Any = diffrax.PIDController(rtol=setting, atol=1e2 * setting) if adaptive else diffrax.ConstantStepSize()
        flown = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: flow(*y, *args)), diffrax.Dopri8(), 0.0, t_max, None if adaptive else setting,
            tuple(y0[i] for i in range(6)), (k[0], k[1]), saveat=diffrax.SaveAt(t1=True), stepsize_controller=control, event=event,
            max_steps=4096, adjoint=diffrax.ForwardMode(), throw=False,
        )  # fmt: skip
        return jnp.where(flown.result == diffrax.RESULTS.event_occurred, jnp.stack([y[-1] for y in flown.ys]), jnp.nan)

    many = jax.vmap(one, in_axes=(0, 0, None, None))
    on_devices = jax.pmap(lambda y0, k, *ends: jax.lax.map(lambda row: many(*row, *ends), (y0, k)), in_axes=(0, 0, None, None))
    devices = len(jax.devices())

    def fly(y0: Array, k: Array, setting: float, t_max: float) -> Array:
        size = min(vector, -(-len(y0) // devices))
        count = -(-len(y0) // (size * devices))
        rows = np.minimum(np.arange(devices * count * size), len(y0) - 1)  # copies of the last case fill the last vector
        ends = on_devices(*(values[rows].reshape(devices, count, size, -1) for values in (y0, k)), setting, t_max)
        return np.asarray(ends).reshape(len(rows), 6)[: len(y0)]

    return fly
