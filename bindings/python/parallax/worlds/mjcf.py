"""A model of MuJoCo (MJCF) as a node of a graph sees it: which command drives which actuator, and what is shown."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .ports import Ports, package

__all__ = ["Machine"]


class Machine:
    """A model, and what of it a graph commands and senses."""

    def __init__(
        self, source: str, commands: Mapping[str, str], outputs: Mapping[str, str], start: Mapping[str, float] | None
    ) -> None:
        """As the worlds take them. Raises `ValueError` when the model has no such part, naming those that it has."""
        self.mujoco: Any = package("mujoco", "mujoco")
        """The package."""
        self.model = self._read(source)
        """MuJoCo's model."""
        self.ports = Ports(commands, lambda name: self._id("actuator", name))
        """The leaves that drive actuators, by port."""
        self.views = {leaf: self._view(leaf, text) for leaf, text in outputs.items()}
        """Where each output is found: the field of the data, the first number and how many."""
        self.positions = {
            int(self.model.jnt_qposadr[self._id("joint", name)]): at for name, at in (start or {}).items()
        }
        """The coordinates that do not start as the model says."""

    def data(self) -> Any:
        """MuJoCo's data at the start."""
        data = self.mujoco.MjData(self.model)
        for place, value in self.positions.items():
            data.qpos[place] = value
        self.mujoco.mj_forward(self.model, data)
        return data

    def shown(self, data: Any) -> dict[str, Any]:
        """What is shown of the data: those of MuJoCo or MJX, or any with fields of these names."""
        made = {}
        for leaf, (field, first, count) in self.views.items():
            values = getattr(data, field)[first : first + count]
            made[leaf] = values[0] if count == 1 else values
        return made

    def _read(self, source: str) -> Any:
        if "<mujoco" in source:
            return self.mujoco.MjModel.from_xml_string(source)
        path = Path(source)
        if not path.is_file():
            raise ValueError(f"there is no model at {path.absolute()}")
        read = self.mujoco.MjModel
        return (read.from_binary_path if path.suffix == ".mjb" else read.from_xml_path)(str(path))

    def _view(self, leaf: str, text: str) -> tuple[str, int, int]:
        sort, _, name = text.partition(":")
        match sort:
            case "sensor":
                sensor = self._id("sensor", name)
                return "sensordata", int(self.model.sensor_adr[sensor]), int(self.model.sensor_dim[sensor])
            case "position" | "velocity":
                joint = self._id("joint", name)
                of = self.mujoco.mjtJoint
                freedoms = {of.mjJNT_FREE: (7, 6), of.mjJNT_BALL: (4, 3)}.get(of(self.model.jnt_type[joint]), (1, 1))
                if sort == "position":
                    return "qpos", int(self.model.jnt_qposadr[joint]), freedoms[0]
                return "qvel", int(self.model.jnt_dofadr[joint]), freedoms[1]
        raise ValueError(f"outputs: `{leaf} = {text}`: it must be position:JOINT, velocity:JOINT or sensor:SENSOR")

    def _id(self, sort: str, name: str) -> int:
        """The number of a part of the model. A joint without a name, as free ones mostly are, has its body's."""
        about = getattr(self.mujoco.mjtObj, f"mjOBJ_{sort.upper()}")
        number = self.mujoco.mj_name2id(self.model, about, name)
        if number < 0 and sort == "joint":
            body = self.mujoco.mj_name2id(self.model, self.mujoco.mjtObj.mjOBJ_BODY, name)
            own = int(self.model.body_jntadr[body]) if body >= 0 and self.model.body_jntnum[body] == 1 else -1
            if own >= 0 and not self.model.joint(own).name:
                return own
        if number < 0:
            count = {"actuator": self.model.nu, "joint": self.model.njnt, "sensor": self.model.nsensor}[sort]
            known = [self.mujoco.mj_id2name(self.model, about, index) or f"(number {index})" for index in range(count)]
            raise ValueError(f"the model has no {sort} `{name}`; it has {', '.join(known) or 'none'}")
        return int(number)
