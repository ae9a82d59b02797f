"""Systems described by equations (`system.toml`) as JAX functions."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from . import _native
from .program import Program
from .types import Array, Scalar, Tree

__all__ = ["Parameter", "System"]


@dataclass(frozen=True)
class Parameter:
    """A number that the equations name."""

    value: float
    """Its nominal value, in `unit`."""
    unit: str
    """Its unit; empty when none is stated."""
    calibrate: tuple[float, float] | None
    """The bounds within which a fit may move it."""


class System:
    """The equations of a `system.toml`: rates of change, outputs, and steps of the Runge–Kutta method.

    Parameters, states, inputs and outputs are dictionaries by name. All functions are pure and work under `jit`,
    `vmap` and `grad`.
    """

    def __init__(self, path: str | os.PathLike[str], constants: Mapping[str, float] | None = None) -> None:
        """Reads the file at `path`, or `system.toml` in the folder there.

        `constants` replace parameters or supply missing ones, as a recording's do. Raises `ParallaxError` with file,
        line and expression when the file cannot be used.
        """
        content = _native.system(path, list((constants or {}).items()))
        self.name: str = content["name"]
        """Its name."""
        self.parameters = {
            name: Parameter(value, unit, None if bounds is None else (bounds[0], bounds[1]))
            for name, value, unit, bounds in content["parameters"]
        }
        """Its parameters, by name."""
        self.inputs: list[str] = content["inputs"]
        """The names of its inputs."""
        self.states: list[str] = [name for name, _ in content["states"]]
        """The names of its states."""
        self.outputs: list[str] = [name for name, _, _, _ in content["outputs"]]
        """The names of its outputs."""
        self.units: dict[str, str] = {name: unit for name, unit, _, _ in content["outputs"]}
        """The outputs' units."""
        self.wraps: dict[str, float] = {name: wrap for name, _, wrap, _ in content["outputs"] if wrap is not None}
        """The periods of circular outputs."""
        self._initial: dict[str, float | None] = dict(content["states"])
        self.derivative_program = Program(content["derivative"])
        """The rates of change as a program."""
        self.output_programs = {name: Program(program) for name, _, _, program in content["outputs"]}
        """The outputs as programs."""

    def params(self) -> dict[str, Array]:
        """The nominal parameters."""
        return {name: jnp.asarray(parameter.value, float) for name, parameter in self.parameters.items()}

    def initial(self) -> dict[str, Array]:
        """The states' fixed initial values, and zero for those that a recording or a fit would give."""
        return {name: jnp.asarray(value or 0.0, float) for name, value in self._initial.items()}

    def _arguments(self, params: Tree, state: Tree, inputs: Tree, time: Scalar) -> list[Scalar]:
        return [
            *(params[name] for name in self.parameters),
            *(state[name] for name in self.states),
            *(inputs[name] for name in self.inputs),
            time,
        ]

    def derivative(self, params: Tree, state: Tree, inputs: Tree, time: Scalar = 0.0) -> dict[str, Scalar]:
        """The states' rates of change, per second."""
        rates = self.derivative_program(*self._arguments(params, state, inputs, time))
        return dict(zip(self.states, rates, strict=True))

    def output(self, params: Tree, state: Tree, inputs: Tree, time: Scalar = 0.0) -> dict[str, Scalar]:
        """What the sensors should read."""
        arguments = self._arguments(params, state, inputs, time)
        return {name: program(*arguments)[0] for name, program in self.output_programs.items()}

    def step(self, params: Tree, state: Tree, inputs: Tree, dt: Scalar, time: Scalar = 0.0) -> dict[str, Scalar]:
        """The state after `dt` seconds under constant inputs, by one step of the Runge–Kutta method of fourth order."""

        def rate(state: Tree, after: Scalar) -> Tree:
            return self.derivative(params, state, inputs, time + after)

        def moved(rates: Tree, by: Scalar) -> Tree:
            return jax.tree.map(lambda x, r: x + by * r, state, rates)

        k1 = rate(state, 0.0)
        k2 = rate(moved(k1, 0.5 * dt), 0.5 * dt)
        k3 = rate(moved(k2, 0.5 * dt), 0.5 * dt)
        k4 = rate(moved(k3, dt), dt)
        return jax.tree.map(lambda x, a, b, c, d: x + dt / 6 * (a + 2 * b + 2 * c + d), state, k1, k2, k3, k4)
