"""MuJoCo in JAX (MJX) as a world: it runs wherever a node in JAX does, compiled with its graph and in batches, too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from ..types import Array, Tree
from .mjcf import Machine
from .ports import package
from .ticked import TickedWorld

__all__ = ["MjxWorld"]


class MjxWorld(TickedWorld):
    """A model of MuJoCo in JAX.

    A step integrates from one tick to the next by the newest commands, in the model's own time steps, of which a period
    holds a whole number. It sends `outputs`. Needs the package `mujoco-mjx`: `pip install './bindings[mjx]'`.
    """

    def __init__(
        self,
        model: str,
        *,
        commands: Mapping[str, str],
        outputs: Mapping[str, str],
        start: Mapping[str, float] | None = None,
        parameters: Sequence[str] = (),
        **settings: Any,
    ) -> None:
        """`model`, `commands`, `outputs` and `start` as for `MujocoWorld`. `parameters` names fields of the model that
        training or a fit may move, such as `body_mass` (kg), `dof_damping` and `dof_frictionloss`. Raises `ValueError`
        when the model has no such part, or a period is no whole number of its time steps.
        """
        super().__init__(**settings)
        self._set_machine(Machine(model, commands, outputs, start))
        self._mjx = package("mujoco.mjx", "mjx")
        self._model = self._mjx.put_model(self._machine.model)
        self._parameters = tuple(parameters)
        unknown = [field for field in parameters if not hasattr(self._model, field)]
        if unknown:
            raise ValueError(f"parameters: a model has no fields {unknown}; it has body_mass, dof_damping, ...")

    def init_params(self, key: Array) -> Tree:
        """The fields of the model that may be moved."""
        return {field: jnp.asarray(getattr(self._model, field)) for field in self._parameters}

    def init_state(self, key: Array, params: Tree) -> Tree:
        """MJX's data at the start."""
        return jax.tree.map(jnp.asarray, self._mjx.put_data(self._machine.model, self._machine.data()))

    def _drive(self, state: Tree) -> Array:
        return state.ctrl

    def _moved(self, params: Tree) -> Any:
        return self._model.replace(**params)

    def _advance(self, model: Any, state: Tree, drive: Array) -> Tree:
        return self._mjx.step(model, state.replace(ctrl=drive))
