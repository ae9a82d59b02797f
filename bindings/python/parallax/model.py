"""The ready-made models as JAX step functions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import jax.numpy as jnp
import numpy as np

from . import _native
from .program import Program
from .trees import flat, nested
from .types import Floats, Scalar, Tree

__all__ = ["Model", "models"]


@dataclass(frozen=True)
class Model:
    """A model in discrete time, on pytrees of scalars (nested dictionaries)."""

    name: str
    """Its name."""
    program: Program
    """One step as a program: inputs `params.*`, `state.*`, `input.*` and `dt` (s), outputs `state.*` and `output.*`."""
    nominal: Floats
    """The nominal parameters, in the order of the program's inputs."""

    def leaves(self, part: str) -> list[str]:
        """The names of the leaves of `params`, `state`, `input` or `output`."""
        names = self.program.outputs if part == "output" else self.program.inputs
        return [name.removeprefix(part).removeprefix(".") for name in names if name.split(".")[0] == part]

    def params(self) -> Tree:
        """The nominal parameters, in SI units."""
        return nested(self.leaves("params"), [jnp.asarray(value, float) for value in self.nominal])

    def step(self, params: Tree, state: Tree, inputs: Tree, dt: Scalar) -> tuple[Tree, Tree]:
        """The state after `dt` seconds under a constant input, and the output there."""
        states = self.leaves("state")
        results = self.program(
            *flat(self.leaves("params"), params, "params"),
            *flat(states, state, "state"),
            *flat(self.leaves("input"), inputs, "inputs"),
            dt,
        )
        return nested(states, results[: len(states)]), nested(self.leaves("output"), results[len(states) :])


@cache
def models() -> dict[str, Model]:
    """The models that come with Parallax, by name: the pendulum and the quadrotor of REX's appendices."""
    return {
        name: Model(name, Program(program), np.asarray(params, np.float64))
        for name, (program, params) in _native.models().items()
    }
