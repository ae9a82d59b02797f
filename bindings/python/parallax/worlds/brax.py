"""Brax as a world: it runs wherever a node in JAX does, compiled with its graph and in batches, too (Freeman et al.,
"Brax: a differentiable physics engine for large scale rigid body simulation", NeurIPS 2021)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import jax
import jax.numpy as jnp

from ..trees import flat, nested
from ..types import Array, Tree
from .mjcf import Machine
from .ports import package
from .ticked import TickedWorld

__all__ = ["BraxWorld"]


class BraxWorld(TickedWorld):
    """An MJCF model in one of Brax's own pipelines.

    A step integrates from one tick to the next by the newest commands, in the model's own time steps, of which a period
    holds a whole number. It sends `outputs`. Brax's authors no longer maintain these pipelines and point to MJX
    (`MjxWorld`). Needs the package `brax`: `pip install './bindings[brax]'`.
    """

    def __init__(
        self,
        model: str,
        *,
        commands: Mapping[str, str],
        outputs: Mapping[str, str],
        start: Mapping[str, float] | None = None,
        parameters: Sequence[str] = (),
        physics: Literal["generalized", "spring", "positional"] = "generalized",
        **settings: Any,
    ) -> None:
        """`model`, `commands` and `start` as for `MujocoWorld`, and `outputs` without sensors, which Brax lacks.

        `parameters` names fields of Brax's system that training or a fit may move, such as `dof.damping`,
        `link.inertia.mass` (kg) and `actuator.gear`. `physics` chooses the pipeline: `generalized` solves for the
        joints' coordinates, `spring` and `positional` approximate joints by constraints and know neither damping,
        stiffness nor armature of joints. Raises `ValueError` when the model has no such part, when Brax does not
        simulate a part of it (a joint's friction loss, tendons, activations of actuators, ...), or when a period is no
        whole number of its time steps.
        """
        super().__init__(**settings)
        if physics not in ("generalized", "spring", "positional"):
            raise ValueError(f"physics: Brax has generalized, spring and positional, not {physics!r}")
        machine = _Machine(physics, model, commands, outputs, start)
        self._set_machine(machine)
        self._pipeline = package(f"brax.{physics}.pipeline", "brax")
        self._system = machine.system
        self._parameters = tuple(parameters)
        # Those of MJX, from which Brax's system is derived, are there and not used.
        own = package("brax.base", "brax").System.__annotations__
        for field in parameters:
            place: Any = self._system if field.split(".")[0] in own else None
            for part in field.split("."):
                place = getattr(place, part, None)
            if not isinstance(place, jax.Array):
                raise ValueError(
                    f"parameters: Brax's system has no array `{field}`; it has dof.damping, dof.armature, "
                    "dof.stiffness, link.inertia.mass, actuator.gear, gravity, ..."
                )

    def init_params(self, key: Array) -> Tree:
        """The fields of the system that may be moved, nested as their names are."""
        values = []
        for field in self._parameters:
            place: Any = self._system
            for part in field.split("."):
                place = getattr(place, part)
            values.append(jnp.asarray(place))
        return nested(self._parameters, values)

    def init_state(self, key: Array, params: Tree) -> Tree:
        """Brax's state at the start."""
        coordinates = jnp.asarray(self._machine.data().qpos)
        try:
            return self._pipeline.init(self._moved(params), coordinates, jnp.zeros(self._system.qd_size()))
        except (NotImplementedError, RuntimeError) as error:
            raise ValueError(f"node {self.name}: Brax does not simulate this model: {error}") from error

    def _drive(self, state: Tree) -> Array:
        return jnp.zeros(self._system.act_size())

    def _moved(self, params: Tree) -> Any:
        if not self._parameters:
            return self._system
        values = flat(self._parameters, params, f"the parameters of node {self.name}")
        return self._system.tree_replace(dict(zip(self._parameters, values, strict=True)))

    def _advance(self, model: Any, state: Tree, drive: Array) -> Tree:
        return self._pipeline.step(model, state, drive)


class _Machine(Machine):
    """A model as Brax reads it: bodies without a joint are part of those that carry them."""

    system: Any
    """Brax's system."""

    def __init__(self, physics: str, *arguments: Any) -> None:
        self._physics = physics
        super().__init__(*arguments)

    def shown(self, data: Any) -> dict[str, Any]:
        fields = SimpleNamespace(qpos=data.q, qvel=data.qd)
        return super().shown(fields)

    def _read(self, source: str) -> Any:
        mjcf = package("brax.io.mjcf", "brax")
        if "<mujoco" in source:
            model = self.mujoco.MjModel.from_xml_string(mjcf.fuse_bodies(source))
        else:
            path = Path(source)
            if not path.is_file():
                raise ValueError(f"there is no model at {path.absolute()}")
            if path.suffix == ".mjb":
                raise ValueError(f"Brax reads MJCF as text (.xml), not {path}")
            model = mjcf.load_mjmodel(path)
        unknown = [what for what, there in _unread(model, self._physics).items() if there]
        if unknown:
            raise ValueError(f"Brax ({self._physics}) does not simulate what this model has: {', '.join(unknown)}")
        try:
            mjcf.validate_model(model)
        except (NotImplementedError, RuntimeError) as error:
            raise ValueError(f"Brax does not simulate this model: {error}") from error
        with warnings.catch_warnings():
            # That it is not maintained is said above.
            warnings.simplefilter("ignore", UserWarning)
            self.system = mjcf.load_model(model)
        return model

    def _view(self, leaf: str, text: str) -> tuple[str, int, int]:
        if text.startswith("sensor:"):
            raise ValueError(f"outputs: `{leaf} = {text}`: Brax has no sensors; show position:JOINT or velocity:JOINT")
        return super()._view(leaf, text)


def _unread(model: Any, physics: str) -> dict[str, bool]:
    """What Brax would leave out without a word."""
    by_constraints = physics != "generalized"
    return {
        "damping of joints": by_constraints and bool((model.dof_damping != 0).any()),
        "stiffness of joints": by_constraints and bool((model.jnt_stiffness != 0).any()),
        "armature of joints": by_constraints and bool((model.dof_armature != 0).any()),
        "frictionloss of joints": bool((model.dof_frictionloss != 0).any()),
        "springref of joints": bool((model.qpos_spring != model.qpos0)[_sprung(model)].any()),
        "limits of joints' forces (actuatorfrcrange)": bool(model.jnt_actfrclimited.any()),
        "equality constraints": bool(model.neq),
        "tendons": bool(model.ntendon),
        "activations of actuators (dyntype)": bool(model.na),
        "compensation of gravity (gravcomp)": bool((model.body_gravcomp != 0).any()),
    }


def _sprung(model: Any) -> list[int]:
    return [int(model.jnt_qposadr[joint]) for joint in range(model.njnt) if model.jnt_stiffness[joint].any()]
