"""A machine of Drake in a graph under the simulated clock, whose angle a controller in plain Python holds.

python examples/python/drake/pendulum.py --out out/drake.mcap
parallax info out/drake.mcap
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import parallax as px
from parallax.worlds import DrakeWorld

HERE = Path(__file__).resolve().parent
Tree = dict[str, Any]


class Agent(px.Node):
    """A voltage that moves the arm to an angle that goes to and fro."""

    def init_params(self, key: jax.Array) -> Tree:
        """Gains in V/rad and V s/rad; the motion in rad and turns a second."""
        return {
            "p": jnp.asarray(6.0),
            "d": jnp.asarray(0.4),
            "angle": jnp.asarray(0.8),
            "turns": jnp.asarray(0.5),
        }

    def init_output(self, key: jax.Array, params: Tree, state: None) -> Tree:
        """No voltage."""
        return {"voltage": jnp.asarray(0.0)}

    def step(self, params: Tree, state: None, step: px.Step) -> tuple[None, Tree]:
        """A PD controller."""
        seen = step["world"].latest.message
        goal = params["angle"] * jnp.sin(2 * jnp.pi * params["turns"] * step.due)
        return state, {
            "voltage": params["p"] * (goal - seen["angle"])
            - params["d"] * seen["speed"]
        }


def graph(clock: Any) -> px.Graph:
    """World, agent and motor."""
    world = DrakeWorld(
        str(HERE / "pendulum.urdf"),
        commands={"motor.voltage": "drive"},
        gains={"drive": 0.0043},
        outputs={"angle": "position:hinge", "speed": "velocity:hinge"},
        start={"hinge": 0.2},
        rate=200.0,
        name="world",
    )
    agent = Agent(rate=50.0, delay=px.Normal(0.002, 0.0005))
    motor = px.RustNode("pendulum/motor", rate=100.0)
    world.connect(motor, window=16, skip=True)
    agent.connect(world)
    motor.connect(agent)
    return px.Graph(agent, [world, agent, motor], clock=clock, name="drake-pendulum")


def main() -> None:
    """Records a run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--out",
        default="out/drake.mcap",
        help="the recording to write (default: out/drake.mcap)",
    )
    parser.add_argument(
        "--duration", type=float, default=10.0, help="seconds (default: 10)"
    )
    arguments = parser.parse_args()
    Path(arguments.out).parent.mkdir(parents=True, exist_ok=True)
    print(graph(px.SIMULATED).simulate(arguments.out, arguments.duration, seed=1))


if __name__ == "__main__":
    main()
