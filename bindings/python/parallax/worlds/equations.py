"""A model of MuJoCo written down as a `system.toml`, by way of MJX.

What is smooth is written down: bodies, joints, springs, dampers, gravity, actuators and their limits. Friction losses
become `coulomb` effects of the system; contacts and joints' limits are left out, and the file says so.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..system import Parameter
from ..types import Tree
from ..written import Joint, Reading, write_system
from .mjcf import Machine
from .ports import package

__all__ = ["write_mjcf_system"]

SMOOTHING = 0.01
"""Speed within which the direction of a friction loss is smoothed, in the joint's unit per second."""


def write_mjcf_system(
    path: str | Path,
    model: str,
    *,
    outputs: Mapping[str, str] | None = None,
    signals: Mapping[str, str] | None = None,
    noise: Mapping[str, float] | None = None,
    calibrate: float = 0.0,
    name: str | None = None,
) -> list[str]:
    """Writes the model, MJCF as a file or as text, to `path`; returns what of it is left out.

    `outputs` are what is read, as for `MujocoWorld` (`position:JOINT`, `velocity:JOINT` or `sensor:SENSOR`, of one
    number each); without it the positions of all joints, called as these are. `signals` are the recorded signals of
    actuators and outputs that are called otherwise there; `noise` is the standard deviation of outputs' noise, where it
    is known. Masses, dampings, stiffnesses, armatures and gears become parameters of the system, which may be refitted
    by the share `calibrate` of themselves.

    Raises `ValueError` when the model has what is not written down (free and ball joints, equality constraints, fluids,
    sensors of accelerations and forces), naming it.
    """
    with jax.enable_x64(True):
        return _write(path, model, outputs, signals or {}, noise or {}, calibrate, name)


def _write(
    path: str | Path,
    model: str,
    outputs: Mapping[str, str] | None,
    signals: Mapping[str, str],
    noise: Mapping[str, float],
    calibrate: float,
    name: str | None,
) -> list[str]:
    mjx = package("mujoco.mjx", "mjx")
    machine = Machine(model, {}, {}, None)
    mujoco, mj = machine.mujoco, machine.model
    _refuse(mujoco, mj, outputs or {})
    joints = _names(mujoco, mj, "joint", mj.njnt)
    actuators = _names(mujoco, mj, "actuator", mj.nu)
    if outputs is None:
        outputs = {joint: f"position:{mj.joint(number).name}" for number, joint in enumerate(joints)}
        unnamed = [joint for joint, text in outputs.items() if text == "position:"]
        if unnamed:
            raise ValueError(f"the model's joints {unnamed} have no name; name them, or say what is read")
    views = Machine(model, {}, outputs, None).views
    wide = [leaf for leaf, (_, _, count) in views.items() if count != 1]
    if wide:
        raise ValueError(f"outputs: {wide} are several numbers each; an output of a system is one")
    unknown = [one for one in [*signals, *noise] if one not in actuators and one not in outputs]
    if unknown:
        raise ValueError(
            f"there is no actuator or output `{unknown[0]}`; there are {', '.join([*actuators, *outputs])}"
        )
    left_out = _left_out(mujoco, mj)
    mj.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model_x = mjx.put_model(mj)
    data_x = mjx.put_data(mj, machine.data())
    parameters, places = _parameters(mujoco, mj, joints, actuators, calibrate)
    memory = [f"act_{number}" for number in range(mj.na)]

    def placed(p: Tree, x: Tree, u: Tree) -> tuple[Any, Any]:
        """The model with these parameters, and what moves at these states, without forces."""
        fields: dict[str, Any] = {}
        for one, (field, index) in places.items():
            values = fields.get(field, jnp.asarray(getattr(model_x, field)))
            fields[field] = values.at[index].set(p[one])
        data = data_x.replace(
            qpos=_row([x[f"q_{joint}"] for joint in joints]),
            qvel=_row([x[f"v_{joint}"] for joint in joints]),
            ctrl=_row([u[actuator] for actuator in actuators]),
            act=_row([x[one] for one in memory]),
        )
        moved = model_x.replace(**fields)
        return moved, mjx.forward(moved, data)

    def drive(p: Tree, x: Tree, u: Tree) -> Tree:
        force = placed(p, x, u)[1].qfrc_actuator
        return {joint: force[number] for number, joint in enumerate(joints)}

    def load(p: Tree, x: Tree) -> Tree:
        still = {**x, **{f"v_{joint}": jnp.zeros(()) for joint in joints}}
        bias = placed(p, still, {actuator: jnp.zeros(()) for actuator in actuators})[1].qfrc_bias
        return {joint: -bias[number] for number, joint in enumerate(joints)}

    def derivative(p: Tree, x: Tree, u: Tree, forces: Tree) -> Tree:
        moved, data = placed(p, x, u)
        applied = _row([forces[joint] for joint in joints])
        data = data.replace(qfrc_actuator=jnp.zeros_like(applied), qfrc_applied=applied)
        acceleration = mjx.fwd_acceleration(moved, data).qacc_smooth
        rates = {f"q_{joint}": x[f"v_{joint}"] for joint in joints}
        rates |= {f"v_{joint}": acceleration[number] for number, joint in enumerate(joints)}
        return rates | {one: data.act_dot[number] for number, one in enumerate(memory)}

    def output(p: Tree, x: Tree, u: Tree) -> Tree:
        data = placed(p, x, u)[1]
        return {leaf: getattr(data, field)[first] for leaf, (field, first, _) in views.items()}

    starts: dict[str, str | float | None] = {}
    for number, joint in enumerate(joints):
        read = [leaf for leaf, view in views.items() if view == ("qpos", int(mj.jnt_qposadr[number]), 1)]
        starts[f"q_{joint}"] = signals.get(read[0], read[0]) if read else None
    starts |= {f"v_{joint}": None for joint in joints}
    starts |= dict.fromkeys(memory, 0.0)
    title = name or ("model" if "<mujoco" in model else Path(model).stem)
    comments = [
        f"What MuJoCo's model `{title}` says of the machine, by way of MJX: edit the signals' names, and which",
        "parameters may be refitted (`calibrate = [low, high]`).",
    ]
    comments += [f"Left out: {what}." for what in left_out]
    write_system(
        path,
        name=title,
        derivative=derivative,
        state=starts,
        output=output,
        outputs={
            leaf: Reading(signals.get(leaf), _unit(mujoco, mj, view), noise.get(leaf)) for leaf, view in views.items()
        },
        inputs={actuator: signals.get(actuator) for actuator in actuators},
        parameters=parameters,
        joints={joint: Joint(f"q_{joint}", f"v_{joint}") for joint in joints},
        drive=drive if mj.nu else None,
        load=load,
        effects=[
            f'[[effect]]\nname = "coulomb"\nplace = "joint:{joint}"\n'
            f"parameters = {{ force = {mj.dof_frictionloss[number]} }}\nsmoothing = {SMOOTHING}"
            for number, joint in enumerate(joints)
            if mj.dof_frictionloss[number] > 0
        ],
        comments=comments,
    )
    return left_out


def _row(values: Sequence[Any]) -> Any:
    return jnp.stack(values) if values else jnp.zeros(0)


def _refuse(mujoco: Any, mj: Any, outputs: Mapping[str, str]) -> None:
    """Names what no system of equations of this kind holds."""
    late_stage = int(mujoco.mjtStage.mjSTAGE_ACC)
    read = {text.partition(":")[2] for text in outputs.values() if text.startswith("sensor:")}
    kinds = {int(mujoco.mjtJoint.mjJNT_FREE): "free", int(mujoco.mjtJoint.mjJNT_BALL): "ball"}
    found = [
        f"the {kinds[int(kind)]} joint `{mj.joint(number).name}`"
        for number, kind in enumerate(mj.jnt_type)
        if int(kind) in kinds
    ]
    found += ["equality constraints"] if mj.neq else []
    late = [
        mj.sensor(number).name
        for number in range(mj.nsensor)
        if int(mj.sensor_needstage[number]) == late_stage and mj.sensor(number).name in read
    ]
    found += [f"the sensor `{sensor}`, of accelerations or forces" for sensor in late]
    found += ["a fluid (density, viscosity)"] if mj.opt.density or mj.opt.viscosity else []
    if found:
        raise ValueError(f"the model has {', '.join(found)}, which cannot be written down as equations yet")


def _left_out(mujoco: Any, mj: Any) -> list[str]:
    found = []
    limited = [mj.joint(number).name for number in range(mj.njnt) if mj.jnt_limited[number]]
    if limited:
        found.append(f"the limits of the joints {', '.join(limited)} (a diagnosis tries `end_stop` there)")
    if mj.tendon_limited.any():
        found.append("the limits of tendons")
    if mj.tendon_frictionloss.any():
        found.append("the friction loss of tendons")
    touching = (mj.geom_contype != 0) | (mj.geom_conaffinity != 0)
    if touching.sum() > 1:
        found.append("contacts between bodies")
    return found


def _names(mujoco: Any, mj: Any, sort: str, count: int) -> list[str]:
    """The names of a model's parts as a `system.toml` allows them."""
    names: list[str] = []
    for number in range(count):
        given = getattr(mj, sort)(number).name or f"{sort}{number}"
        text = re.sub(r"\W", "_", given, flags=re.ASCII)
        names.append(text if text[0].isalpha() or text[0] == "_" else f"{sort}_{text}")
    double = sorted({one for one in names if names.count(one) > 1})
    if double:
        raise ValueError(
            f"the {sort}s {double} cannot be told apart when written with letters, digits and `_`; rename them"
        )
    return names


def _parameters(
    mujoco: Any, mj: Any, joints: Sequence[str], actuators: Sequence[str], calibrate: float
) -> tuple[dict[str, Parameter], dict[str, Any]]:
    """The numbers of the model that the system names, and where they stand in it."""
    turns = [kind == mujoco.mjtJoint.mjJNT_HINGE for kind in mj.jnt_type]
    found: dict[str, tuple[float, str, str, Any]] = {}
    for body in range(1, mj.nbody):
        label = re.sub(r"\W", "_", mj.body(body).name or f"{body}", flags=re.ASCII)
        if mj.body_mass[body] > 0 and mj.body_weldid[body] != 0:
            found[f"mass_{label}"] = (mj.body_mass[body], "kg", "body_mass", body)
    for number, joint in enumerate(joints):
        unit = "N m" if turns[number] else "N"
        per = "rad" if turns[number] else "m"
        inertia = "kg m^2" if turns[number] else "kg"
        if mj.dof_damping[number] != 0:
            found[f"damping_{joint}"] = (mj.dof_damping[number], f"{unit} s/{per}", "dof_damping", number)
        if mj.dof_armature[number] != 0:
            found[f"armature_{joint}"] = (mj.dof_armature[number], inertia, "dof_armature", number)
        if mj.jnt_stiffness[number] != 0:
            found[f"stiffness_{joint}"] = (mj.jnt_stiffness[number], f"{unit}/{per}", "jnt_stiffness", number)
    for number, actuator in enumerate(actuators):
        found[f"gear_{actuator}"] = (mj.actuator_gear[number, 0], "", "actuator_gear", (number, 0))
    if not 0.0 <= calibrate < 1.0:
        raise ValueError(f"calibrate: {calibrate} is no share from 0 to 1")

    def stated(value: float, unit: str) -> Parameter:
        bounds = sorted([value * (1.0 - calibrate), value * (1.0 + calibrate)])
        return Parameter(value, unit, (bounds[0], bounds[1]) if calibrate and value else None)

    parameters = {one: stated(float(value), unit) for one, (value, unit, _, _) in found.items()}
    return parameters, {one: (field, index) for one, (_, _, field, index) in found.items()}


def _unit(mujoco: Any, mj: Any, view: tuple[str, int, int]) -> str:
    field, first, _ = view
    if field == "sensordata":
        return ""
    numbers = mj.jnt_qposadr if field == "qpos" else mj.jnt_dofadr
    turns = mj.jnt_type[int(np.flatnonzero(numbers == first)[0])] == mujoco.mjtJoint.mjJNT_HINGE
    return ("rad" if turns else "m") + ("" if field == "qpos" else "/s")
