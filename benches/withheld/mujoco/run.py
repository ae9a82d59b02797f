"""A run of a machine: commands through a queue, bodies by MuJoCo, readings that come late or biased."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout

from causes import Cause, Random
from machines import Machine, about_shaft

STEP = 0.5e-3
"""MuJoCo's time step, s."""
COMMANDS, READINGS = 50, 100
"""Rates, Hz."""
DURATION = 20.0
"""Length of a recording, s."""


class Diverged(ValueError):
    """The motion left all bounds: MuJoCo began anew on the way."""


def excitation(machine: Machine, size: float, random: Random) -> np.ndarray:
    """A command at every tick: sines, steps or a sweep."""
    ticks = int(DURATION * COMMANDS)
    time = np.arange(ticks) / COMMANDS
    size *= random.uniform(0.5, 1.4)
    match random.integers(3):
        case 0:
            lines = [(random.normal(), random.uniform(0.1, 4.0), random.uniform(0, 2 * math.pi)) for _ in range(6)]
            wave = sum(a * np.sin(2 * math.pi * f * time + phase) for a, f, phase in lines)
        case 1:
            wave = np.empty(0)
            while len(wave) < ticks:
                length = int(random.uniform(0.1, 0.8) * COMMANDS) + 1
                wave = np.append(wave, np.full(length, random.uniform(-1, 1)))
            wave = wave[:ticks]
        case _:
            low, high = random.uniform(0.1, 0.3), random.uniform(3.0, 6.0)
            wave = np.sin(2 * math.pi * (low * time + (high - low) * time**2 / 2 / DURATION))
            wave *= np.where(np.sin(2 * math.pi * 0.11 * time) > 0, 1.0, 0.5)
    wave = wave * 0.65 * size / max(float(np.sqrt(np.mean(wave**2))), 1e-9)
    return np.clip(wave, -2.5 * size, 2.5 * size)


def acting(commands: np.ndarray, of: list[Cause]) -> np.ndarray:
    """What acts in each of MuJoCo's steps: messages in a queue, then the actuator."""
    steps = int(DURATION / STEP)
    time = np.arange(steps) * STEP
    late = sum(cause.parameters["delay"] for cause in of if cause.kind == "delay")
    arrived = np.searchsorted(np.arange(len(commands)) / COMMANDS + late, time + 1e-9, side="right") - 1
    u = commands[np.maximum(arrived, 0)]
    for cause in of:
        p = cause.parameters
        match cause.kind:
            case "gain":
                u = p["gain"] * u
            case "offset":
                u = u + p["offset"]
            case "saturation":
                u = np.clip(u, p["low"], p["high"])
            case "deadband":
                u = np.where(np.abs(u) < p["width"], 0.0, u - np.sign(u) * p["width"])
            case "lag" | "rate_limit" | "backlash":
                u = remembering(u, cause)
    return u


def remembering(u: np.ndarray, cause: Cause) -> np.ndarray:
    """Actuators with a memory, step by step."""
    acts, state = np.empty_like(u), float(u[0])
    let = 1 - math.exp(-STEP / cause.parameters.get("time_constant", math.inf))
    rate = cause.parameters.get("rate", math.inf) * STEP
    half = cause.parameters.get("gap", 0.0) / 2
    for k, wish in enumerate(u.tolist()):
        before = state
        if cause.kind == "lag":
            state += (wish - state) * let
        elif cause.kind == "rate_limit":
            state += min(max(wish - state, -rate), rate)
        else:
            state = min(max(state, wish - half), wish + half)
        acts[k] = 0.5 * (before + state) if cause.kind == "lag" else state
    return acts


def model(machine: Machine, p: dict[str, float], found: list[Cause]) -> mujoco.MjModel:
    """MuJoCo's model with the causes that it has itself."""
    p = p | {cause.place.partition(":")[2]: cause.parameters["value"] for cause in found if cause.kind == "parameter"}
    ball = sum(cause.parameters["mass"] for cause in found if cause.kind == "payload")
    body = machine.body(p, ball)
    soft = next((cause for cause in found if cause.kind == "flexibility"), None)
    if soft is not None:
        # The motor's rotor on a shaft of its own; the link turns against it on a spring.
        name, q = soft.place.partition(":")[2], soft.parameters
        rotor, link = q["ratio"] * p["J"], (1 - q["ratio"]) * p["J"]
        spring = f'<joint name="{name}" type="hinge" axis="0 -1 0" stiffness="{q["stiffness"]!r}" damping='
        body = (
            f'<body><joint name="rotor" type="hinge" axis="0 -1 0" damping="{p["b"]!r}"/>'
            f'<inertial pos="0 0 0" mass="0.01" diaginertia="{rotor!r} {rotor!r} {rotor!r}"/>'
            f'<body>{spring}"{q["damping"]!r}"/>{about_shaft(p["mgl"], link)}</body></body>'
        )
    driven = "".join(f'<motor joint="{name}"/>' for name in machine.joints)
    text = (
        f'<mujoco><option timestep="{STEP!r}" integrator="implicitfast" gravity="0 0 -9.81"/>'
        f"<worldbody>{body}</worldbody><actuator>{driven}</actuator></mujoco>"
    )
    own = mujoco.MjModel.from_xml_string(text)
    for cause in found:
        where, _, name = cause.place.partition(":")
        if where != "joint":
            continue
        q, joint = cause.parameters, own.joint(name)
        dof, index = joint.dofadr[0], joint.id
        match cause.kind:
            case "viscous":
                own.dof_damping[dof] += q["coefficient"]
            case "coulomb":
                own.dof_frictionloss[dof] = q["force"]
            case "spring":
                own.jnt_stiffness[index] = q["stiffness"]
                own.qpos_spring[joint.qposadr[0]] = q["rest"]
            case "inertia":
                own.dof_armature[dof] += q["added"]
            case "end_stop":
                own.jnt_limited[index] = 1
                own.jnt_range[index] = (-1e3, q["limit"])
                # By stiffness and damping themselves; MuJoCo scales them by the inertia that the constraint sees.
                own.jnt_solimp[index] = (0.95, 0.95, 0.001, 0.5, 2)
                scaled = q["stiffness"] * own.dof_invweight0[dof]
                own.jnt_solref[index] = (-scaled, -2 * 0.1 * math.sqrt(scaled))
            case "gravity_tilt":
                own.opt.gravity[:] = 9.81 * np.array([-math.sin(q["angle"]), 0.0, -math.cos(q["angle"])])
    return own


@dataclass(frozen=True)
class Case:
    """A machine with its real parameters, its commands, and what it has."""

    machine: Machine
    real: dict[str, float]
    commands: np.ndarray
    """(inputs, ticks)."""
    causes: list[Cause]

    def readings(self) -> np.ndarray:
        """What the sensors show before noise, (outputs, samples)."""
        machine = self.machine
        own = model(machine, self.real, self.causes)
        keys = list(machine.inputs)
        u = np.stack([acting(self.commands[k], self.at(f"input:{key}")) for k, key in enumerate(keys)], axis=1)
        force = np.zeros((len(u), len(machine.joints)))
        force[:, : u.shape[1]] = u * self.real.get("K", 1.0)
        time = np.arange(len(u)) * STEP
        for k, name in enumerate(machine.joints):
            for cause in self.at(f"joint:{name}"):
                p = cause.parameters
                if cause.kind == "constant_force":
                    force[:, k] += p["force"]
                if cause.kind == "periodic_disturbance":
                    force[:, k] += p["amplitude"] * np.sin(2 * math.pi * p["frequency"] * time + p["phase"])
        bends = any(cause.kind == "flexibility" for cause in self.causes)
        if bends:
            # The motor turns the rotor.
            own.actuator_trnid[0, 0] = own.joint("rotor").id
        data = mujoco.MjData(own)
        first = np.zeros(mujoco.mj_stateSize(own, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(own, data, first, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        states, _ = rollout.rollout(own, data, first[None], force[None], persistent_pool=False)
        # The first number of a state is its time: MuJoCo sets a simulation back that has become unstable.
        if not abs(states[0, -1, 0] - DURATION) < STEP:
            raise Diverged(f"{machine.name} with {[cause.label for cause in self.causes]}")
        at = np.concatenate([np.zeros((1, own.nq)), states[0, :, 1 : 1 + own.nq]])
        if bends:
            at = at.sum(axis=1, keepdims=True)
        every = int(1 / READINGS / STEP)
        shown = []
        for k, name in enumerate(machine.outputs):
            true = at[:, k]
            late = 0.0
            for cause in self.at(f"output:{name}"):
                if cause.kind == "sensor_lag":
                    true = lagged(true, cause.parameters["time_constant"])
                late += cause.parameters.get("delay", 0.0)
            stamp = np.arange(0, len(true) - 1, every) * STEP
            y = np.interp(stamp - late, np.arange(len(true)) * STEP, true)
            for cause in self.at(f"output:{name}"):
                p = cause.parameters
                y = p.get("scale", 1.0) * y + p.get("bias", 0.0) + (p["rate"] * stamp if cause.kind == "drift" else 0.0)
            shown.append(y)
        return np.stack(shown)

    def at(self, place: str) -> list[Cause]:
        """The causes at a place."""
        return [cause for cause in self.causes if cause.place == place]


def lagged(y: np.ndarray, time: float) -> np.ndarray:
    """A low-pass of first order."""
    shown, state, let = np.empty_like(y), float(y[0]), 1 - math.exp(-STEP / time)
    for k, value in enumerate(y.tolist()):
        state += (value - state) * let
        shown[k] = state
    return shown
