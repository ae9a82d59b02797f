"""MuJoCo as a world: the machine that a graph commands and senses is an MJCF model (Todorov, Erez & Tassa, "MuJoCo: A
physics engine for model-based control", IROS 2012)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..types import Tree
from .mjcf import Machine
from .stamped import StampedWorld

__all__ = ["MujocoWorld"]


class MujocoWorld(StampedWorld):
    """A model of MuJoCo, on the wall clock and under the simulated one.

    ```python
    world = MujocoWorld(
        "pendulum.xml", commands={"motor.voltage": "drive"}, outputs={"angle": "position:hinge"}, rate=200.0
    )
    world.connect(motor, window=16, skip=True)
    ```

    It sends `outputs` and `stamp`, the time of the simulation (s since the run's start). Needs the package `mujoco`:
    `pip install './bindings[mujoco]'`.
    """

    def __init__(
        self,
        model: str,
        *,
        commands: Mapping[str, str],
        outputs: Mapping[str, str],
        start: Mapping[str, float] | None = None,
        **settings: Any,
    ) -> None:
        """`model` is the path of an MJCF file (`.xml`, `.mjb`), or its text.

        `commands` names the actuator that a leaf of a message drives, as `PORT.LEAF`; between two commands it is held,
        and it is zero before the first. `outputs` says what each leaf shows: `position:JOINT` and `velocity:JOINT`
        (rad, rad/s, m, m/s; of a free or ball joint all coordinates), or `sensor:SENSOR`. `start` gives joints of one
        coordinate other positions to begin with (rad or m). Connect with a window that holds the commands of two steps
        at least. Raises `ValueError` when the model has no such part, naming those that it has.
        """
        super().__init__(**settings)
        self._machine = Machine(model, commands, outputs, start)
        self._mujoco, self._model = self._machine.mujoco, self._machine.model
        self._step = float(self._model.opt.timestep)
        # As of the last command, and what is shown: predicted from there.
        self._kept, self._shown = self._machine.data(), self._mujoco.MjData(self._model)
        self._set_ports(self._machine.ports)

    def init_output(self) -> Tree:
        """What is shown at the start."""
        return self._message(self._kept)

    def _advance(self, time: float) -> None:
        self._integrate(self._kept, time)

    def _drive(self, actuator: int, command: float) -> None:
        self._kept.ctrl[actuator] = command

    def _predicted(self, time: float) -> Tree:
        self._mujoco.mj_copyData(self._shown, self._model, self._kept)
        self._integrate(self._shown, time)
        return self._message(self._shown)

    def _integrate(self, data: Any, time: float) -> None:
        """Integrates in equal steps of at most the model's own."""
        span = time - data.time
        if span <= 0.0:
            return
        count = math.ceil(span / self._step - 1e-9)
        self._model.opt.timestep = span / count
        for _ in range(count):
            self._mujoco.mj_step(self._model, data)
        data.time = time
        if data.warning[self._mujoco.mjtWarning.mjWARN_BADQACC].number:
            raise FloatingPointError(
                f"node {self.name}: the simulation is unstable at {time:.4f} s; use a smaller timestep"
            )

    def _message(self, data: Any) -> Tree:
        # What follows from the state at its end: positions of bodies, sensors.
        self._mujoco.mj_forward(self._model, data)
        shown = {
            leaf: np.array(values) if np.ndim(values) else float(values)
            for leaf, values in self._machine.shown(data).items()
        }
        return shown | {"stamp": float(data.time)}
