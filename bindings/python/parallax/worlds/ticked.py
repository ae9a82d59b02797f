"""Simulators in JAX, which step from tick to tick wherever a node in JAX does."""

from __future__ import annotations

from typing import Any

from jax import lax

from ..member import Node
from ..nodes import Step
from ..types import Array, Tree
from .mjcf import Machine

__all__ = ["TickedWorld"]


class TickedWorld(Node):
    """An MJCF model that steps from one tick to the next by the newest commands, in the model's own time steps."""

    _machine: Machine
    _substeps: int

    def _set_machine(self, machine: Machine) -> None:
        """Raises `ValueError` when a period is no whole number of the model's time steps."""
        self._machine = machine
        steps = 1.0 / (self.rate * float(machine.model.opt.timestep))
        self._substeps = round(steps)
        if self._substeps < 1 or abs(steps - self._substeps) > 1e-6:
            raise ValueError(
                f"node {self.name}: a period of {1.0 / self.rate} s is {steps:.4f} time steps of the model; choose a "
                "rate or a timestep that makes it a whole number"
            )

    def init_output(self, key: Array, params: Tree, state: Tree) -> Tree:
        """What is shown at the start."""
        return self._machine.shown(state)

    def step(self, params: Tree, state: Tree, step: Step) -> tuple[Tree, Tree]:
        """From the tick before to this one."""
        self._machine.ports.check(self.name, step.inputs)
        drive = self._drive(state)
        for port in self._machine.ports:
            for actuator, value in self._machine.ports.driven(port, step[port].latest.message):
                drive = drive.at[actuator].set(value)
        model = self._moved(params)

        def advance(state: Any, _: None) -> tuple[Any, None]:
            return self._advance(model, state, drive), None

        state, _ = lax.scan(advance, state, None, length=self._substeps)
        return state, self._machine.shown(state)

    def _drive(self, state: Tree) -> Array:
        """The commands of all actuators before the messages change some, `[actuator]`."""
        raise NotImplementedError

    def _moved(self, params: Tree) -> Any:
        """The model with these parameters."""
        raise NotImplementedError

    def _advance(self, model: Any, state: Tree, drive: Array) -> Tree:
        """One time step."""
        raise NotImplementedError
