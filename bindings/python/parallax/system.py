"""Systems described by equations (`system.toml`) as JAX functions."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

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

    The effects that the file states (`[[effect]]`, as a diagnosis adds them to a corrected system) act; one that cannot
    act without a recording or a graph is an error that says why.

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
        self.hidden: list[str] = content["hidden"]
        """The names of the states that the system's own effects bring, such as that of a lag."""
        self.outputs: list[str] = [name for name, _, _ in content["outputs"]]
        """The names of its outputs."""
        self.units: dict[str, str] = {name: unit for name, unit, _ in content["outputs"]}
        """The outputs' units."""
        self.wraps: dict[str, float] = {name: wrap for name, _, wrap in content["outputs"] if wrap is not None}
        """The periods of circular outputs."""
        self._initial: dict[str, float | None] = dict(content["states"])
        self._memory: list[str] = content["memory"]
        self.rate_program = Program(content["rates"])
        """The states' rates of change and the outputs as a program."""
        self.tick_program = Program(content["tick"])
        """One step as a program."""

    def params(self) -> dict[str, Array]:
        """The nominal parameters."""
        return {name: jnp.asarray(parameter.value, float) for name, parameter in self.parameters.items()}

    def initial(self, inputs: Tree | None = None) -> dict[str, Array]:
        """The states' fixed initial values, and zero for those that a recording or a fit would give.

        An effect that remembers commands has settled at `inputs`, or at zero.
        """
        state = {name: jnp.asarray(value or 0.0, float) for name, value in self._initial.items()}
        state |= {name: jnp.asarray(0.0, float) for name in self.hidden}
        if self._memory and inputs is not None:
            arguments = [*self._arguments(self.params(), state, inputs, 0.0), 1e-3, 1.0]
            settled = dict(zip([*self.states, *self.hidden], self.tick_program(*arguments), strict=False))
            state |= {name: settled[name] for name in self._memory}
        return state

    def _arguments(self, params: Tree, state: Tree, inputs: Tree, time: Scalar) -> list[Scalar]:
        return [
            *(params[name] for name in self.parameters),
            *(state[name] for name in [*self.states, *self.hidden]),
            *(inputs[name] for name in self.inputs),
            time,
        ]

    def derivative(self, params: Tree, state: Tree, inputs: Tree, time: Scalar = 0.0) -> dict[str, Scalar]:
        """The states' rates of change, per second; what remembers commands moves with `step` alone."""
        values = self.rate_program(*self._arguments(params, state, inputs, time))
        moving = [name for name in [*self.states, *self.hidden] if name not in self._memory]
        return dict(zip(moving, values, strict=False))

    def output(self, params: Tree, state: Tree, inputs: Tree, time: Scalar = 0.0) -> dict[str, Scalar]:
        """What the sensors should read."""
        values = self.rate_program(*self._arguments(params, state, inputs, time))
        return dict(zip(self.outputs, values[len(values) - len(self.outputs) :], strict=True))

    def step(self, params: Tree, state: Tree, inputs: Tree, dt: Scalar, time: Scalar = 0.0) -> dict[str, Scalar]:
        """The state after `dt` seconds under constant inputs.

        One step of the Runge–Kutta method of fourth order, or two where an effect remembers commands.
        """
        values = self.tick_program(*self._arguments(params, state, inputs, time), dt, 0.0)
        return dict(zip([*self.states, *self.hidden], values, strict=False))
