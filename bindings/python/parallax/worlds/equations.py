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
from .freedoms import DIRECTIONS, Freedoms, feels_speed, floats, rotation, row, turned
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

    Raises `ValueError` when the model has what is not written down (equality constraints, fluids, sensors of
    accelerations and forces), naming it.
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
    freedoms = Freedoms(mujoco, mj, joints)
    named = _named_views(mj, joints) if outputs is None else Machine(model, {}, outputs, None).views
    views = {leaf: view for name, wide in named.items() for leaf, view in _numbers(name, wide).items()}
    unknown = [one for one in [*signals, *noise] if one not in actuators and one not in named]
    if unknown:
        raise ValueError(f"there is no actuator or output `{unknown[0]}`; there are {', '.join([*actuators, *named])}")
    signals = {leaf: given for name, wide in named.items() for leaf, given in _signals(name, wide, signals)} | {
        one: signals[one] for one in actuators if one in signals
    }
    noise = {leaf: noise[name] for name, wide in named.items() if name in noise for leaf in _numbers(name, wide)}
    left_out = _left_out(mujoco, mj)
    mj.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    floating = floats(mujoco, mj)
    gravity = np.zeros(3) if mj.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY else mj.opt.gravity.copy()
    if floating:
        mj.opt.gravity[:] = 0.0  # Of what floats it moves every part alike.
    model_x = mjx.put_model(mj)
    data_x = mjx.put_data(mj, machine.data())
    parameters, places = _parameters(mujoco, mj, joints, freedoms, actuators, calibrate)
    gyros = {
        ("sensordata", int(first) + axis)
        for first, sort in zip(mj.sensor_adr, mj.sensor_type, strict=True)
        for axis in range(3)
        if mujoco.mjtSensor(int(sort)) == mujoco.mjtSensor.mjSENS_GYRO
    }
    memory = [f"act_{number}" for number in range(mj.na)]

    def placed(p: Tree, x: Tree, u: Tree, own: bool = floating) -> tuple[Any, Any]:
        """The model with these parameters, and what moves at these states, without forces; `own`: in the floating
        body's own frame."""
        fields: dict[str, Any] = {}
        for one, (field, index) in places.items():
            values = fields.get(field, jnp.asarray(getattr(model_x, field)))
            fields[field] = values.at[index].set(p[one])
        qpos, qvel = freedoms.qpos(x), freedoms.qvel(x)
        if own:
            moving = rotation(qpos[3:7]).T @ row(qvel[:3]) if feels_speed(mj) else jnp.zeros(3)
            qvel[:3] = list(moving)
            qpos[:7] = [jnp.asarray(value) for value in (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)]
        data = data_x.replace(
            qpos=row(qpos),
            qvel=row(qvel),
            ctrl=row([u[actuator] for actuator in actuators]),
            act=row([x[one] for one in memory]),
        )
        moved = model_x.replace(**fields)
        return moved, mjx.forward(moved, data)

    def out(x: Tree, values: Any) -> Any:
        return turned(rotation(freedoms.qpos(x)[3:7]), values) if floating else values

    def drive(p: Tree, x: Tree, u: Tree) -> Tree:
        force = out(x, placed(p, x, u)[1].qfrc_actuator)
        return {one.name: force[number] for number, one in enumerate(freedoms.all)}

    def load(p: Tree, x: Tree) -> Tree:
        still = {**x, **{one.velocity: jnp.zeros(()) for one in freedoms.all}}
        moved, data = placed(p, still, {actuator: jnp.zeros(()) for actuator in actuators})
        if floating:
            falling = rotation(freedoms.qpos(x)[3:7]).T @ gravity
            pull = out(x, mjx.full_m(moved, data)[:, :3] @ falling)
        else:
            pull = -data.qfrc_bias
        return {one.name: pull[number] for number, one in enumerate(freedoms.all)}

    def derivative(p: Tree, x: Tree, u: Tree, forces: Tree) -> Tree:
        moved, data = placed(p, x, u)
        applied = row([forces[one.name] for one in freedoms.all])
        if floating:
            applied = turned(rotation(freedoms.qpos(x)[3:7]).T, applied)
        data = data.replace(qfrc_actuator=jnp.zeros_like(applied), qfrc_applied=applied)
        acceleration = out(x, mjx.fwd_acceleration(moved, data).qacc_smooth)
        if floating:
            acceleration = acceleration.at[:3].add(gravity)
        rates = freedoms.rates(x) | {one.velocity: acceleration[number] for number, one in enumerate(freedoms.all)}
        return rates | {one: data.act_dot[number] for number, one in enumerate(memory)}

    def output(p: Tree, x: Tree, u: Tree) -> Tree:
        data = placed(p, x, u, own=False)[1].replace(qpos=row(freedoms.qpos(x)))  # Of the length that it has.
        # What turns with the body is read in its own frame, without a way to the world's and back.
        inner = placed(p, x, u)[1]
        return {
            leaf: getattr(inner if (field, first) in gyros else data, field)[first]
            for leaf, (field, first, _) in views.items()
        }

    starts: dict[str, str | float | Parameter | None] = {}
    for place, one in enumerate(freedoms.positions):
        read = [leaf for leaf, view in views.items() if view == ("qpos", place, 1)]
        starts[one] = signals.get(read[0], read[0]) if read else None
        if not read and freedoms.is_quaternion(place):
            # Nothing is turned by a quaternion of zeros.
            starts[one] = Parameter(freedoms.start[place], "", (-1.0, 1.0))
    starts |= {one.velocity: None for one in freedoms.all}
    starts |= dict.fromkeys(memory, 0.0)
    title = name or ("model" if "<mujoco" in model else Path(model).stem)
    comments = [
        f"What MuJoCo's model `{title}` says of the machine, by way of MJX: edit the signals' names, and which",
        "parameters may be refitted (`calibrate = [low, high]`).",
    ]
    if freedoms.quaternions:
        comments += [
            "A rotation is the quaternion from the body's frame to the world's, scalar first. Its rates, half of it",
            "times the angular velocity in the body's frame, keep its length; forces take it as of unit length. Places",
            "that end with x, y and z are forces along the world's axes, with rx, ry and rz torques about the body's.",
        ]
    comments += [f"Left out: {what}." for what in left_out]
    write_system(
        path,
        name=title,
        derivative=derivative,
        state=starts,
        output=output,
        outputs={
            leaf: Reading(signals.get(leaf), _unit(freedoms, view), noise.get(leaf)) for leaf, view in views.items()
        },
        inputs={actuator: signals.get(actuator) for actuator in actuators},
        parameters=parameters,
        joints={one.name: Joint(one.position, one.velocity) for one in freedoms.all},
        drive=drive if mj.nu else None,
        load=load,
        effects=[
            f'[[effect]]\nname = "coulomb"\nplace = "joint:{one.name}"\n'
            f"parameters = {{ force = {mj.dof_frictionloss[number]} }}\nsmoothing = {SMOOTHING}"
            for number, one in enumerate(freedoms.all)
            if mj.dof_frictionloss[number] > 0
        ],
        comments=comments,
    )
    return left_out


def _numbers(name: str, view: tuple[str, int, int]) -> dict[str, tuple[str, int, int]]:
    """An output of several numbers as one of each, called as the leaves of a message are."""
    field, first, count = view
    return {name: view} if count == 1 else {f"{name}_{at}": (field, first + at, 1) for at in range(count)}


def _signals(name: str, view: tuple[str, int, int], signals: Mapping[str, str]) -> list[tuple[str, str]]:
    """The signal of each number of an output."""
    given = signals.get(name)
    return [] if given is None else list(zip(_numbers(name, view), _numbers(given, view), strict=True))


def _named_views(mj: Any, joints: Sequence[str]) -> dict[str, tuple[str, int, int]]:
    """The positions of all joints, by the joints' names."""
    unnamed = [
        joint
        for number, joint in enumerate(joints)
        if not mj.joint(number).name and not mj.body(mj.jnt_bodyid[number]).name
    ]
    if unnamed:
        raise ValueError(f"the model's joints {unnamed} have no name; name them, or say what is read")
    ends = [*mj.jnt_qposadr[1:], mj.nq]
    first = [int(place) for place in mj.jnt_qposadr]
    return {joint: ("qpos", begin, int(end) - begin) for joint, begin, end in zip(joints, first, ends, strict=True)}


def _refuse(mujoco: Any, mj: Any, outputs: Mapping[str, str]) -> None:
    """Names what no system of equations of this kind holds."""
    late_stage = int(mujoco.mjtStage.mjSTAGE_ACC)
    read = {text.partition(":")[2] for text in outputs.values() if text.startswith("sensor:")}
    found = ["equality constraints"] if mj.neq else []
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
        given = getattr(mj, sort)(number).name
        if not given and sort == "joint":
            given = mj.body(mj.jnt_bodyid[number]).name  # As free joints are mostly written: without a name.
        given = given or f"{sort}{number}"
        text = re.sub(r"\W", "_", given, flags=re.ASCII)
        names.append(text if text[0].isalpha() or text[0] == "_" else f"{sort}_{text}")
    double = sorted({one for one in names if names.count(one) > 1})
    if double:
        raise ValueError(
            f"the {sort}s {double} cannot be told apart when written with letters, digits and `_`; rename them"
        )
    return names


def _parameters(
    mujoco: Any, mj: Any, joints: Sequence[str], freedoms: Freedoms, actuators: Sequence[str], calibrate: float
) -> tuple[dict[str, Parameter], dict[str, Any]]:
    """The numbers of the model that the system names, and where they stand in it."""
    found: dict[str, tuple[float, str, str, Any]] = {}
    for body in range(1, mj.nbody):
        label = re.sub(r"\W", "_", mj.body(body).name or f"{body}", flags=re.ASCII)
        if mj.body_mass[body] > 0 and mj.body_weldid[body] != 0:
            found[f"mass_{label}"] = (mj.body_mass[body], "kg", "body_mass", body)
    for number, joint in enumerate(joints):
        own = freedoms.of_joint[number]
        turns = {freedoms.all[at].turns for at in own}
        unit, per, inertia = ("N m", "rad", "kg m^2") if turns == {True} else ("N", "m", "kg")
        # One number of a free joint is of forces and of torques: its label is that of SI.
        units = [f"{unit} s/{per}", inertia, f"{unit}/{per}"] if len(turns) == 1 else ["SI"] * 3
        where = own.start if len(own) == 1 else np.array(own)
        if mj.dof_damping[own.start] != 0:
            found[f"damping_{joint}"] = (mj.dof_damping[own.start], units[0], "dof_damping", where)
        if mj.dof_armature[own.start] != 0:
            found[f"armature_{joint}"] = (mj.dof_armature[own.start], units[1], "dof_armature", where)
        if mj.jnt_stiffness[number] != 0:
            found[f"stiffness_{joint}"] = (mj.jnt_stiffness[number], units[2], "jnt_stiffness", number)
    for number, actuator in enumerate(actuators):
        gears = np.flatnonzero(mj.actuator_gear[number])
        for at in gears:
            label = f"gear_{actuator}" if len(gears) == 1 else f"gear_{actuator}_{DIRECTIONS[at]}"
            found[label] = (mj.actuator_gear[number, at], "", "actuator_gear", (number, at))
    if not 0.0 <= calibrate < 1.0:
        raise ValueError(f"calibrate: {calibrate} is no share from 0 to 1")

    def stated(value: float, unit: str) -> Parameter:
        bounds = sorted([value * (1.0 - calibrate), value * (1.0 + calibrate)])
        return Parameter(value, unit, (bounds[0], bounds[1]) if calibrate and value else None)

    parameters = {one: stated(float(value), unit) for one, (value, unit, _, _) in found.items()}
    return parameters, {one: (field, index) for one, (_, _, field, index) in found.items()}


def _unit(freedoms: Freedoms, view: tuple[str, int, int]) -> str:
    field, first, _ = view
    if field == "sensordata" or (field == "qpos" and freedoms.is_quaternion(first)):
        return ""
    if field == "qvel":
        return "rad/s" if freedoms.all[first].turns else "m/s"
    of = next(one for one in freedoms.all if one.position == freedoms.positions[first])
    return "rad" if of.turns else "m"
