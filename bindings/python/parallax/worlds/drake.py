"""Drake's plants as a world (Tedrake and the Drake Development Team, "Drake: Model-based design and verification for
robotics", 2019)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..types import Tree
from .ports import Ports, package
from .stamped import StampedWorld

__all__ = ["DrakeWorld"]


class DrakeWorld(StampedWorld):
    """A `MultibodyPlant` of Drake in continuous time, under the simulated clock and on the wall clock.

    ```python
    world = DrakeWorld(
        "pendulum.urdf", commands={"motor.torque": "drive"}, outputs={"angle": "position:hinge"}, rate=200.0
    )
    world.connect(motor, window=16, skip=True)
    ```

    It sends `outputs` and `stamp`, the time of the simulation (s since the run's start). Needs the package `drake`:
    `pip install './bindings[drake]'`.
    """

    def __init__(
        self,
        model: str,
        *,
        commands: Mapping[str, str],
        outputs: Mapping[str, str],
        start: Mapping[str, float] | None = None,
        gains: Mapping[str, float] | None = None,
        accuracy: float = 1e-5,
        **settings: Any,
    ) -> None:
        """`model` is the path of a URDF, SDF or MJCF file, or its text. A base that is to stand still must be fixed to
        the world there (in URDF by a joint to the link `world`); what Drake leaves out of a file, it says on standard
        error.

        `commands` names the actuator that a leaf of a message drives, as `PORT.LEAF`: its joint's effort, N m or N, is
        the command times its number in `gains` (1, if not said). Between two commands it is held, and it is zero before
        the first. `outputs` says what each leaf shows: `position:JOINT` and `velocity:JOINT` (rad, rad/s, m, m/s; of a
        joint of several coordinates all of them). `start` gives joints of one coordinate other positions to begin with
        (rad or m). `accuracy` is that of the integrator, relative. Connect with a window that holds the commands of two
        steps at least. Raises `ValueError` when the model cannot be read, or has no such part, naming those that it
        has.
        """
        super().__init__(**settings)
        self._drake = package("pydrake.all", "drake")
        self._diagram, self._plant = self._built(model)
        self._set_ports(Ports(commands, self._actuator))
        self._gains = np.ones(self._plant.num_actuators())
        for name, gain in (gains or {}).items():
            self._gains[self._actuator(name)] = gain
        self._views = {leaf: self._view(leaf, text) for leaf, text in outputs.items()}
        # As of the last command, and what is shown: predicted from there.
        self._kept, self._shown = self._simulator(accuracy), self._simulator(accuracy)
        self._efforts = np.zeros(self._plant.num_actuators())
        root = self._kept.get_mutable_context()
        context = self._plant.GetMyMutableContextFromRoot(root)
        for name, value in (start or {}).items():
            joint = self._joint(name)
            if joint.num_positions() != 1:
                raise ValueError(f"start: the joint `{name}` has {joint.num_positions()} coordinates, not one")
            positions = self._plant.GetPositions(context)
            positions[joint.position_start()] = value
            self._plant.SetPositions(context, positions)
        self._kept.Initialize()

    def init_output(self) -> Tree:
        """What is shown at the start."""
        return self._message(self._kept)

    def _advance(self, time: float) -> None:
        self._integrate(self._kept, time)

    def _drive(self, actuator: int, command: float) -> None:
        self._efforts[actuator] = self._gains[actuator] * command

    def _predicted(self, time: float) -> Tree:
        root = self._shown.get_mutable_context()
        root.SetTimeStateAndParametersFrom(self._kept.get_context())
        self._shown.Initialize()
        self._integrate(self._shown, time)
        return self._message(self._shown)

    def _integrate(self, simulator: Any, time: float) -> None:
        root = simulator.get_mutable_context()
        if time <= root.get_time():
            return
        context = self._plant.GetMyMutableContextFromRoot(root)
        self._plant.get_actuation_input_port().FixValue(context, self._efforts)
        try:
            simulator.AdvanceTo(time)
        except RuntimeError as error:
            raise FloatingPointError(f"node {self.name}: Drake stopped at {root.get_time():.4f} s: {error}") from error

    def _message(self, simulator: Any) -> Tree:
        root = simulator.get_context()
        context = self._plant.GetMyContextFromRoot(root)
        have = {"position": self._plant.GetPositions(context), "velocity": self._plant.GetVelocities(context)}
        shown: Tree = {}
        for leaf, (sort, first, count) in self._views.items():
            values = have[sort][first : first + count]
            shown[leaf] = float(values[0]) if count == 1 else np.array(values)
        return shown | {"stamp": float(root.get_time())}

    def _built(self, source: str) -> tuple[Any, Any]:
        drake = self._drake
        builder = drake.DiagramBuilder()
        plant, _ = drake.AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        parser = drake.Parser(plant)
        try:
            for mark, sort in (("<robot", "urdf"), ("<sdf", "sdf"), ("<mujoco", "xml")):
                if mark in source:
                    parser.AddModelsFromString(source, sort)
                    break
            else:
                if not Path(source).is_file():
                    raise ValueError(f"there is no model at {Path(source).absolute()}")
                parser.AddModels(source)
            plant.Finalize()
        except RuntimeError as error:
            raise ValueError(f"node {self.name}: Drake does not read this model: {error}") from error
        return builder.Build(), plant

    def _simulator(self, accuracy: float) -> Any:
        simulator = self._drake.Simulator(self._diagram, self._diagram.CreateDefaultContext())
        simulator.get_mutable_integrator().set_target_accuracy(accuracy)
        return simulator

    def _view(self, leaf: str, text: str) -> tuple[str, int, int]:
        sort, _, name = text.partition(":")
        match sort:
            case "position":
                joint = self._joint(name)
                return sort, joint.position_start(), joint.num_positions()
            case "velocity":
                joint = self._joint(name)
                return sort, joint.velocity_start(), joint.num_velocities()
        raise ValueError(f"outputs: `{leaf} = {text}`: it must be position:JOINT or velocity:JOINT")

    def _joint(self, name: str) -> Any:
        joints = [self._plant.get_joint(index) for index in self._plant.GetJointIndices()]
        return _named(name, "joint", [joint for joint in joints if joint.num_positions()])

    def _actuator(self, name: str) -> int:
        actuators = [self._plant.get_joint_actuator(index) for index in self._plant.GetJointActuatorIndices()]
        found = _named(name, "actuator", actuators)
        if found.num_inputs() != 1:
            raise ValueError(f"commands: the actuator `{name}` takes {found.num_inputs()} numbers, not one")
        return int(found.input_start())


def _named(name: str, sort: str, parts: list[Any]) -> Any:
    """The part of this name."""
    for part in parts:
        if part.name() == name:
            return part
    raise ValueError(f"the model has no {sort} `{name}`; it has {', '.join(part.name() for part in parts) or 'none'}")
