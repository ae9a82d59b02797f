"""MuJoCo as a world: the machine that a graph commands and senses is an MJCF model (Todorov, Erez & Tassa, "MuJoCo: A
physics engine for model-based control", IROS 2012).

It integrates to the stamps of the commands, not to its own wake-ups: a command that arrives late still acts from when
it was sent, and the scheduler's jitter does not become a delay of the machine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..member import PlainNode
from ..nodes import Step
from ..types import Tree
from .mjcf import Machine

__all__ = ["MujocoWorld"]


class MujocoWorld(PlainNode):
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
        self._last = dict.fromkeys(self._machine.ports, -1)

    def init_output(self) -> Tree:
        """What is shown at the start."""
        return self._message(self._kept)

    def step(self, step: Step) -> Tree:
        """What is shown now, given the commands that have come."""
        news = []
        for port in self._machine.ports:
            if port not in step.inputs:
                raise ValueError(
                    f"node {self.name}: nothing is connected to the port `{port}`; it has {[*step.inputs]}"
                )
            for message in step[port]:
                if message.seq > self._last[port]:
                    self._last[port] = message.seq
                    news.append((message.sent, port, message.message))
        for sent, port, message in sorted(news, key=lambda command: command[0]):
            self._advance(self._kept, sent)
            for leaf, actuator in self._machine.ports[port]:
                self._kept.ctrl[actuator] = float(self._machine.command(message, leaf, port))
        self._mujoco.mj_copyData(self._shown, self._model, self._kept)
        self._advance(self._shown, step.start)
        return self._message(self._shown)

    def _advance(self, data: Any, time: float) -> None:
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
