"""MuJoCo as a world: the machine that a graph commands and senses is an MJCF model (Todorov, Erez & Tassa, "MuJoCo: A
physics engine for model-based control", IROS 2012).

It integrates to the stamps of the commands, not to its own wake-ups: a command that arrives late still acts from when
it was sent, and the scheduler's jitter does not become a delay of the machine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..member import PlainNode
from ..nodes import Step
from ..types import Tree

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
        self._model = _model(model)
        self._mujoco: Any = _package()
        self._actuators = {leaf: self._id("actuator", name) for leaf, name in commands.items()}
        self._ports: dict[str, list[tuple[str, int]]] = {}
        for leaf, actuator in self._actuators.items():
            port, dot, name = leaf.partition(".")
            if not dot or not name:
                raise ValueError(f"commands: `{leaf}` must look like PORT.LEAF, such as motor.voltage")
            self._ports.setdefault(port, []).append((name, actuator))
        self._views = {leaf: self._view(leaf, text) for leaf, text in outputs.items()}
        self._step = float(self._model.opt.timestep)
        # As of the last command, and what is shown: predicted from there.
        self._kept = self._mujoco.MjData(self._model)
        for joint, value in (start or {}).items():
            self._kept.qpos[self._model.jnt_qposadr[self._id("joint", joint)]] = value
        self._mujoco.mj_forward(self._model, self._kept)
        self._shown = self._mujoco.MjData(self._model)
        self._last = dict.fromkeys(self._ports, -1)

    def init_output(self) -> Tree:
        """What is shown at the start."""
        return self._message(self._kept)

    def step(self, step: Step) -> Tree:
        """What is shown now, given the commands that have come."""
        news = []
        for port in self._ports:
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
            for leaf, actuator in self._ports[port]:
                self._kept.ctrl[actuator] = _leaf(message, leaf, port)
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
        shown: dict[str, Any] = {}
        for leaf, (field, first, count) in self._views.items():
            values = getattr(data, field)[first : first + count]
            shown[leaf] = float(values[0]) if count == 1 else np.array(values)
        return shown | {"stamp": float(data.time)}

    def _view(self, leaf: str, text: str) -> tuple[str, int, int]:
        """The field of the data that an output shows, where in it, and how many numbers."""
        sort, _, name = text.partition(":")
        match sort:
            case "sensor":
                sensor = self._id("sensor", name)
                return "sensordata", int(self._model.sensor_adr[sensor]), int(self._model.sensor_dim[sensor])
            case "position" | "velocity":
                joint = self._id("joint", name)
                of = self._mujoco.mjtJoint
                freedoms = {of.mjJNT_FREE: (7, 6), of.mjJNT_BALL: (4, 3)}.get(of(self._model.jnt_type[joint]), (1, 1))
                if sort == "position":
                    return "qpos", int(self._model.jnt_qposadr[joint]), freedoms[0]
                return "qvel", int(self._model.jnt_dofadr[joint]), freedoms[1]
        raise ValueError(f"outputs: `{leaf} = {text}`: it must be position:JOINT, velocity:JOINT or sensor:SENSOR")

    def _id(self, sort: str, name: str) -> int:
        """The number of a part of the model."""
        about = getattr(self._mujoco.mjtObj, f"mjOBJ_{sort.upper()}")
        number = self._mujoco.mj_name2id(self._model, about, name)
        if number < 0:
            count = {"actuator": self._model.nu, "joint": self._model.njnt, "sensor": self._model.nsensor}[sort]
            known = [
                self._mujoco.mj_id2name(self._model, about, index) or f"(number {index})" for index in range(count)
            ]
            raise ValueError(f"the model has no {sort} `{name}`; it has {', '.join(known) or 'none'}")
        return int(number)


def _package() -> Any:
    try:
        import mujoco
    except ImportError as error:
        raise ImportError("a world of MuJoCo needs the package `mujoco`: pip install './bindings[mujoco]'") from error
    return mujoco


def _model(source: str) -> Any:
    mujoco = _package()
    if "<mujoco" in source:
        return mujoco.MjModel.from_xml_string(source)
    path = Path(source)
    if not path.is_file():
        raise ValueError(f"there is no model at {path.absolute()}")
    load = mujoco.MjModel.from_binary_path if path.suffix == ".mjb" else mujoco.MjModel.from_xml_path
    return load(str(path))


def _leaf(message: Tree, leaf: str, port: str) -> float:
    value = message
    for part in leaf.split("."):
        if not isinstance(value, Mapping) or part not in value:
            raise ValueError(f"a message at the port `{port}` has no leaf `{leaf}`: {message!r}")
        value = value[part]
    return float(value)
