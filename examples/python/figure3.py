"""A graph of nodes in Python and in Rust: on the wall clock, under a simulated clock, and compiled.

The nodes and the three runs are those of figure 3 of "REX: GPU-Accelerated Sim2Real Framework with Delay and Dynamics
Estimation" (van der Heijden et al.): a camera, an agent and a motor. The machine is a pendulum, which a world of Rust
stands in for; in simulation a world in JAX takes its place.

python examples/python/figure3.py
"""

from __future__ import annotations

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import parallax as px

Tree = dict[str, Any]


class Camera(px.Node):
    """Shows where the mass is: two coordinates from -1 to 1, and the picture's number."""

    def init_output(self, key: jax.Array, params: None, state: None) -> Tree:
        """The pendulum hangs."""
        return {"mass": jnp.array([0.0, -1.0]), "picture": jnp.asarray(0)}

    def step(self, params: None, state: None, step: px.Step) -> tuple[None, Tree]:
        """A picture of the newest angle, which is zero upright."""
        angle = step["world"].latest.message["angle"]
        return state, {
            "mass": jnp.stack([jnp.sin(angle), jnp.cos(angle)]),
            "picture": jnp.asarray(step.seq),
        }


class Agent(px.Node):
    """Pumps energy into the pendulum: a voltage in the direction in which it moves."""

    def __init__(self, most: float = 2.0, **settings: Any) -> None:
        super().__init__(**settings)
        self.most = most

    def init_params(self, key: jax.Array) -> Tree:
        """The voltage, V, and how fast it rises with the speed."""
        return {"most": jnp.asarray(self.most), "gain": jnp.asarray(5.0)}

    def init_state(self, key: jax.Array, params: Tree) -> Tree:
        """The place in the picture before."""
        return {"mass": jnp.array([0.0, -1.0])}

    def init_output(self, key: jax.Array, params: Tree, state: Tree) -> Tree:
        """No voltage."""
        return {"voltage": jnp.asarray(0.0)}

    def step(self, params: Tree, state: Tree, step: px.Step) -> tuple[Tree, Tree]:
        """The turn between two pictures, as a voltage."""
        now, before = step["cam"].latest.message["mass"], state["mass"]
        turned = now[0] * before[1] - now[1] * before[0]
        voltage = params["most"] * jnp.tanh(params["gain"] * turned + 0.1)
        return {"mass": now}, {"voltage": voltage}


class Pendulum(px.Node):
    """The machine, simulated: a pendulum on the shaft of a DC motor (appendix C of the paper), SI units."""

    def init_params(self, key: jax.Array) -> Tree:
        """Inertia, motor constant, resistance, damping, and weight times the length to the mass."""
        return {"J": 1.6e-4, "K": 0.0333, "R": 7.73, "b": 1.43e-5, "mgl": 0.0207}

    def init_state(self, key: jax.Array, params: Tree) -> Tree:
        """It hangs, nearly."""
        return {
            "angle": jnp.pi + 0.1 * jax.random.normal(key),
            "speed": jnp.asarray(0.0),
        }

    def init_output(self, key: jax.Array, params: Tree, state: Tree) -> Tree:
        """Angle and speed; they are the state before the first step."""
        return {"angle": state["angle"], "speed": state["speed"]}

    def step(self, params: Tree, state: Tree, step: px.Step) -> tuple[Tree, Tree]:
        """Ten milliseconds of Runge and Kutta."""
        voltage, dt, p = step["motor"].latest.message["voltage"], 0.01, params

        def slope(x: jax.Array) -> jax.Array:
            force = (
                p["K"] * voltage / p["R"]
                - p["K"] ** 2 * x[1] / p["R"]
                + p["mgl"] * jnp.sin(x[0])
                - p["b"] * x[1]
            )
            return jnp.stack([x[1], force / p["J"]])

        x = jnp.stack([state["angle"], state["speed"]])
        k1 = slope(x)
        k2 = slope(x + dt / 2 * k1)
        k3 = slope(x + dt / 2 * k2)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + dt * k3))
        new = {"angle": x[0], "speed": x[1]}
        return new, new


def real() -> px.Graph:
    """The machine (here a world of Rust that stands in for it), in real time."""
    world = px.RustNode("pendulum/world", rate=200.0)
    cam = Camera(rate=60.0, name="cam")
    agent = Agent(rate=30.0)
    motor = px.RustNode("pendulum/motor", rate=50.0)
    cam.connect(world)
    agent.connect(cam)
    motor.connect(agent, block=True, window=2)
    world.connect(motor, window=16, skip=True)
    return px.Graph(agent, [world, cam, agent, motor], clock=px.WALL_CLOCK)


def simulated_nodes() -> tuple[px.Member, list[px.Member]]:
    """The same with a simulated machine, and the delays of all steps and messages, s."""
    world = Pendulum(rate=100.0, name="world", delay=px.Constant(0.001))
    cam = Camera(rate=60.0, name="cam", delay=px.Normal(0.010, 0.002))
    agent = Agent(rate=30.0, delay=px.Normal(0.005, 0.001))
    motor = px.RustNode("pendulum/motor", rate=50.0, delay=px.Normal(0.002, 0.0005))
    world.connect(motor, delay=px.Normal(0.005, 0.001), skip=True)
    cam.connect(world, delay=px.Normal(0.002, 0.0005))
    agent.connect(cam, delay=px.Normal(0.002, 0.0005))
    motor.connect(agent, delay=px.Normal(0.002, 0.0005), block=True, window=2)
    return agent, [world, cam, agent, motor]


def main() -> None:
    """All three, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--steps",
        type=int,
        default=100,
        help="how many steps of the agent (default: 100)",
    )
    parser.add_argument(
        "--device",
        default="cpu",
        help="where the agent steps on the wall clock (default: cpu)",
    )
    arguments = parser.parse_args()

    graph = real()
    graph.warmup(devices={"agent": arguments.device})
    state = graph.init()
    for _ in range(arguments.steps):
        state = graph.run(state)
    graph.stop()
    record = graph.get_record()
    late = 1e3 * (record["agent"].end - record["agent"].start)
    print(f"wall clock: {record}, a step of the agent took {late.mean():.3f} ms")
    print(
        f"  pictures {record['cam'].tree['mass'].shape}, the last one number {record['cam'].tree['picture'][-1]}"
    )

    agent, nodes = simulated_nodes()
    graph = px.Graph(
        agent, nodes, clock=px.SIMULATED, real_time_factor=px.FAST_AS_POSSIBLE
    )
    graph.warmup()
    state = graph.init(seed=1)
    for _ in range(arguments.steps):
        state = graph.run(state)
    graph.stop()
    record = graph.get_record()
    print(f"simulated: {record}")

    compiled = graph.compile(record.to_graph().augment(nodes))
    states = jax.vmap(compiled.init)(jax.random.split(jax.random.key(0), 1000))
    rollout = jax.jit(
        jax.vmap(
            lambda state: compiled.rollout(
                state, record=lambda now: now.state["world"]["angle"]
            )
        )
    )
    _, angles = rollout(states)
    print(f"compiled: {compiled}, angles {angles.shape}")


if __name__ == "__main__":
    main()
