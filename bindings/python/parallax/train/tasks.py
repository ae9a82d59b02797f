"""The paper's two tasks: the pendulum's swing-up, and the quadrotor on a circle."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp

from ..state import GraphState
from ..types import Array, Scalar
from .task import with_state

__all__ = ["PendulumSwingUp", "QuadrotorCircle"]


def wrapped(angle: Scalar) -> Array:
    """The same angle, rad, within [−π, π)."""
    return jnp.asarray(angle - 2 * math.pi * jnp.floor((angle + math.pi) / (2 * math.pi)))


@dataclass(frozen=True)
class PendulumSwingUp:
    """Swing the pendulum up and keep it there.

    The reward of a step is `−(θ² + 0.1 (θ̇/(1 + 10 |θ|))² + 0.05 u² + 0.05 Δu²)` with θ from upright in rad, θ̇ in rad/s
    and the voltage u in V: speed costs near the top, where the pendulum should stand, and little on the way there. No
    state ends an episode.
    """

    observations: Sequence[str] = ("cos(angle)", "sin(angle)", "speed")
    """What the policy observes; a camera shows no speed."""
    voltage: float = 4.0
    """The largest, V. What holds the weight level is 4.8 V."""
    seconds: float = 3.0
    """How long an episode lasts, s."""
    world: str = "world"
    """The node that simulates the pendulum: `angle` and `speed` are leaves of its state."""
    messages: Mapping[str, Sequence[str]] = field(
        default_factory=lambda: {"world": ("angle", "speed"), "encoder": ("angle", "speed")}
    )
    """The leaves of the nodes' messages that show the pendulum; those before an episode show its first state."""
    speed: float = 9.0
    """Episodes start anywhere with a speed within ± this, rad/s."""
    hanging: float = 0.25
    """The share of episodes that start hanging nearly still, as a machine does."""

    @property
    def actions(self) -> dict[str, tuple[float, float]]:
        """The voltage."""
        return {"voltage": (-self.voltage, self.voltage)}

    def start(self, key: Array, state: GraphState) -> GraphState:
        """Anywhere, or hanging."""
        angle, speed, choice = jax.random.uniform(key, (3,), float, -1.0, 1.0)
        hangs = choice < 2 * self.hanging - 1
        first = {
            "angle": jnp.where(hangs, wrapped(math.pi + 0.1 * angle), math.pi * angle),
            "speed": jnp.where(hangs, 0.1 * speed, self.speed * speed),
        }
        state = with_state(state, self.world, first)
        for sender, leaves in self.messages.items():
            if sender in state.history:
                state = with_state(state, self.world, {leaf: first[leaf] for leaf in leaves}, [sender])
        return state

    def reward(self, before: GraphState, last: Array, action: Array, after: GraphState) -> Array:
        """Less the farther, the faster near the top, and the harder it pushes."""
        angle, speed = wrapped(after.state[self.world]["angle"]), after.state[self.world]["speed"]
        push = 0.05 * action[0] ** 2 + 0.05 * (action[0] - last[0]) ** 2
        return -(angle**2 + 0.1 * (speed / (1 + 10 * jnp.abs(angle))) ** 2 + push)

    def terminated(self, state: GraphState) -> Array:
        """Never."""
        return jnp.asarray(False)

    def metrics(self, state: GraphState) -> dict[str, Array]:
        """`upright`: within 10° and 0.5 rad/s, as in the paper's figure 8."""
        angle, speed = wrapped(state.state[self.world]["angle"]), state.state[self.world]["speed"]
        return {"upright": jnp.asarray((jnp.abs(angle) < math.radians(10)) & (jnp.abs(speed) < 0.5), float)}


@dataclass(frozen=True)
class QuadrotorCircle:
    """Fly along a circle at a constant height, as fast as it can while staying on it.

    The policy commands roll and pitch; the height is given. The reward of a step is
    `v exp(−(e/0.2)²) − 2 e − 0.2 |w| − 2 |Δ(roll, pitch)|²` with the speed v along the path (counter-clockwise) and w
    across it in m/s, and the distance e from the circle in m: speed counts as far as it is near the path. Flying away
    or tilting over ends an episode.
    """

    observations: Sequence[str] = (
        "position.x",
        "position.y",
        "position.z",
        "velocity.x",
        "velocity.y",
        "velocity.z",
        "attitude.roll",
        "attitude.pitch",
    )
    """What the policy observes."""
    radius: float = 1.0
    """Of the circle, m."""
    height: float = 1.0
    """Of the circle, m."""
    tilt: float = math.pi / 5
    """Largest roll and pitch that it may ask for, rad."""
    seconds: float = 5.0
    """How long an episode lasts, s."""
    world: str = "world"
    """The node that simulates the quadrotor."""
    messages: Sequence[str] = ("world", "mocap")
    """The nodes whose messages before an episode show its first state."""
    reach: float = 3.0
    """How far from the circle's middle an episode goes on, m."""
    numbers: Sequence[str] = ("radius",)
    """What may change without another compilation: see `EnvironmentParams.task`."""

    @property
    def actions(self) -> dict[str, tuple[float, float]]:
        """Roll and pitch; the height hardly moves."""
        angles = (-self.tilt, self.tilt)
        return {"roll": angles, "pitch": angles, "height": (self.height - 0.1, self.height + 0.1)}

    def start(self, key: Array, state: GraphState) -> GraphState:
        """Near the circle, slowly."""
        angle, distance, height, *velocity = jax.random.uniform(key, (6,), float, -1.0, 1.0)
        angle, distance = math.pi * angle, self.radius * (1.0 + 0.4 * distance)
        first = {
            "position.x": distance * jnp.cos(angle),
            "position.y": distance * jnp.sin(angle),
            "position.z": self.height + 0.2 * height,
            "velocity.x": 0.5 * velocity[0],
            "velocity.y": 0.5 * velocity[1],
            "velocity.z": 0.1 * velocity[2],
        }
        return with_state(state, self.world, first, [name for name in self.messages if name in state.history])

    def reward(self, before: GraphState, last: Array, action: Array, after: GraphState) -> Array:
        """Fast along the path, near it, without jerks."""
        along, across, error = self._path(after)
        near = jnp.exp(-((error / 0.2) ** 2))
        turned = jnp.sum((action[:2] - last[:2]) ** 2)
        return along * near - 2 * error - 0.2 * across - 2 * turned

    def terminated(self, state: GraphState) -> Array:
        """Away from the circle, on the ground, or tilted over."""
        own = state.state[self.world]
        place, attitude = own["position"], own["attitude"]
        away = jnp.hypot(place["x"], place["y"]) > self.reach
        low = (place["z"] < 0.1) | (place["z"] > self.height + self.reach)
        over = (jnp.abs(attitude["roll"]) > 1.2) | (jnp.abs(attitude["pitch"]) > 1.2)
        return away | low | over

    def metrics(self, state: GraphState) -> dict[str, Array]:
        """`speed` along the path, m/s, and `error`, the distance from it, m: those of the paper's table 3."""
        along, _, error = self._path(state)
        return {"speed": along, "error": error}

    def _path(self, state: GraphState) -> tuple[Array, Array, Array]:
        """Speed along the path and across it, m/s, and the distance from it, m."""
        own = state.state[self.world]
        place, velocity = own["position"], own["velocity"]
        # At the middle every direction is as good as another, and has a derivative.
        distance = jnp.sqrt(place["x"] ** 2 + place["y"] ** 2 + 1e-12)
        x, y = place["x"] / distance, place["y"] / distance
        along = velocity["y"] * x - velocity["x"] * y
        outwards = velocity["x"] * x + velocity["y"] * y
        across = jnp.sqrt(outwards**2 + velocity["z"] ** 2 + 1e-12)
        error = jnp.sqrt((distance - self.radius) ** 2 + (place["z"] - self.height) ** 2 + 1e-12)
        return along, across, error
