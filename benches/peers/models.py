"""The equations of the pendulum and of the quadrotor in JAX, as nodes/src/models has them in Rust, and their work.

A state, its parameters and an action are dictionaries of arrays, or of numbers under `vmap`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import common

GRAVITY = 9.81


@dataclass
class Model:
    """One system, and what is done with it."""

    name: str
    derivative: Callable[[Any, Any, Any], Any]  # parameters, state, action
    nominal: dict[str, float]
    start: dict[str, float]
    bounds: dict[str, tuple[float, float]]  # of the random actions

    def parameters(self, envs, number):
        """Distinct parameters for every environment, within 5 % of the nominal ones."""
        rng = np.random.default_rng(1)
        return {k: (v * rng.uniform(0.95, 1.05, envs)).astype(number) for k, v in self.nominal.items()}

    def state(self, envs, number):
        """The first states."""
        return {k: np.full(envs, v, number) for k, v in self.start.items()}

    def actions(self, envs, number, steps=common.STEPS):
        """Random actions, [steps][envs]."""
        rng = np.random.default_rng(2)
        return {k: rng.uniform(*v, (steps, envs)).astype(number) for k, v in self.bounds.items()}


def rk4(f, p, x, u, dt):
    """One step of the Runge-Kutta method of fourth order."""

    def moved(k, h):
        return jax.tree_util.tree_map(lambda a, b: a + b * h, x, k)

    k1 = f(p, x, u)
    k2 = f(p, moved(k1, dt * 0.5), u)
    k3 = f(p, moved(k2, dt * 0.5), u)
    k4 = f(p, moved(k3, dt), u)
    slopes = lambda a, b, c, d, e: a + (b + 2 * c + 2 * d + e) * (dt / 6)
    return jax.tree_util.tree_map(slopes, x, k1, k2, k3, k4)


def _pendulum(p, x, u):
    """Appendix C."""
    torque = (
        u["voltage"] * p["motor"] / p["resistance"]
        + p["mass"] * p["length"] * GRAVITY * jnp.sin(x["angle"])
        - x["speed"] * (p["damping"] + p["motor"] * p["motor"] / p["resistance"])
        - p["friction"] * jnp.sign(x["speed"])
    )
    return {"angle": x["speed"], "speed": torque / p["inertia"]}


PENDULUM = Model(
    name="pendulum",
    derivative=_pendulum,
    nominal={
        "inertia": 1.6e-4,
        "mass": 0.0509,
        "length": 0.0415,
        "damping": 1.43e-5,
        "motor": 0.0333,
        "resistance": 7.73,
        "friction": 9.75e-4,
    },
    start={"angle": np.pi, "speed": 0.0},
    bounds={"voltage": (-2.0, 2.0)},
)


def _quadrotor(p, x, u):
    """Appendix D, as nodes/src/models/quadrotor.rs reads it."""
    thrust = p["thrust_state"] * x["thrust"] + p["thrust_direct"] * u["pwm"]
    root = p["pwm_linear"] ** 2 - 4 * p["pwm_quadratic"] * (p["pwm_constant"] - thrust * 0.25)
    pwm = (jnp.sqrt(jnp.maximum(root, 0.0)) - p["pwm_linear"]) / (2 * p["pwm_quadratic"])
    rotors = 4 * (p["rotor_linear"] * pwm + p["rotor_constant"])
    sr, cr = jnp.sin(x["roll"]), jnp.cos(x["roll"])
    sp, cp = jnp.sin(x["pitch"]), jnp.cos(x["pitch"])
    sy, cy = jnp.sin(x["yaw"]), jnp.cos(x["yaw"])
    r = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    v = [x["vx"], x["vy"], x["vz"]]
    body = [r[0][i] * v[0] + r[1][i] * v[1] + r[2][i] * v[2] for i in range(3)]
    force = [
        -p["drag_xy"] * rotors * body[0],
        -p["drag_xy"] * rotors * body[1],
        thrust - p["drag_z"] * rotors * body[2],
    ]
    ax, ay, az = [(row[0] * force[0] + row[1] * force[1] + row[2] * force[2]) / p["mass"] for row in r]
    rate = p["attitude_gain"] / p["attitude_time"]
    return {
        "x": x["vx"],
        "y": x["vy"],
        "z": x["vz"],
        "vx": ax,
        "vy": ay,
        "vz": az - GRAVITY,
        "roll": (u["roll"] - x["roll"]) * rate,
        "pitch": (u["pitch"] - x["pitch"]) * rate,
        "yaw": jnp.zeros_like(x["yaw"]),
        "thrust": p["motor_rate"] * x["thrust"] + p["motor_gain"] * u["pwm"],
    }


QUADROTOR = Model(
    name="quadrotor",
    derivative=_quadrotor,
    nominal={
        "mass": 0.03,
        "attitude_gain": 1.0,
        "attitude_time": 0.15,
        "drag_xy": 9.18e-7,
        "drag_z": 1.03e-6,
        "motor_rate": -15.47,
        "motor_gain": 1.0,
        "thrust_state": 1.43e-4,
        "thrust_direct": 2.89e-7,
        "pwm_quadratic": 2.13e-11,
        "pwm_linear": 1.03e-6,
        "pwm_constant": 5.49e-4,
        "rotor_linear": 0.041,
        "rotor_constant": 380.83,
    },
    start=dict.fromkeys(["x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw", "thrust"], 0.0),
    bounds={"pwm": (3.0e4, 4.0e4), "roll": (-0.3, 0.3), "pitch": (-0.3, 0.3)},
)

MODELS = [PENDULUM, QUADROTOR]
