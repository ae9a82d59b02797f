"""A machine of MuJoCo in a graph: under the simulated clock and in real time, recorded for the diagnosis.

python examples/python/mujoco/pendulum.py --out out/mujoco.mcap
parallax diagnose --system examples/python/mujoco/system.toml out/mujoco.mcap --out out/mujoco
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import parallax as px
from parallax.worlds import MujocoWorld

HERE = Path(__file__).resolve().parent
Tree = dict[str, Any]


class Encoder(px.Node):
    """The angle, with half a milliradian of noise."""

    def init_output(self, key: jax.Array, params: None, state: None) -> Tree:
        """It hangs."""
        return {"angle": jnp.asarray(0.0), "stamp": jnp.asarray(0.0)}

    def step(self, params: None, state: None, step: px.Step) -> tuple[None, Tree]:
        """What the world shows, as of when it was so."""
        seen = step["world"].latest.message
        return state, {
            "angle": seen["angle"] + 5e-4 * step.noise(1)[0],
            "stamp": seen["stamp"],
        }


class Agent(px.Node):
    """Voltages of many frequencies, so that the motion shows everything."""

    def init_output(self, key: jax.Array, params: None, state: None) -> Tree:
        """No voltage."""
        return {"voltage": jnp.asarray(0.0)}

    def step(self, params: None, state: None, step: px.Step) -> tuple[None, Tree]:
        """Five sines, from 0.2 to 2.5 Hz."""
        turns = jnp.array([0.2, 0.53, 0.97, 1.61, 2.5])
        phases = jnp.array([0.0, 1.3, 2.1, 0.4, 4.0])
        return state, {
            "voltage": 0.9 * jnp.sum(jnp.sin(2 * jnp.pi * turns * step.due + phases))
        }


def graph(clock: Any) -> px.Graph:
    """World, encoder, agent and motor."""
    world = MujocoWorld(
        str(HERE / "pendulum.xml"),
        commands={"motor.voltage": "drive"},
        outputs={"angle": "position:hinge", "speed": "velocity:hinge"},
        rate=200.0,
        name="world",
    )
    encoder = Encoder(rate=100.0, delay=px.Normal(0.0005, 0.0001))
    agent = Agent(rate=50.0, delay=px.Normal(0.001, 0.0002))
    motor = px.RustNode("pendulum/motor", rate=100.0)
    world.connect(motor, window=16, skip=True)
    encoder.connect(world, block=True)
    agent.connect(encoder)
    motor.connect(agent)
    return px.Graph(
        agent, [world, encoder, agent, motor], clock=clock, name="mujoco-pendulum"
    )


def main() -> None:
    """Records a run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--out",
        default="out/mujoco.mcap",
        help="the recording to write (default: out/mujoco.mcap)",
    )
    parser.add_argument(
        "--duration", type=float, default=20.0, help="seconds (default: 20)"
    )
    parser.add_argument(
        "--real-time",
        action="store_true",
        help="in real time, not under the simulated clock",
    )
    arguments = parser.parse_args()
    Path(arguments.out).parent.mkdir(parents=True, exist_ok=True)
    made = graph(px.WALL_CLOCK if arguments.real_time else px.SIMULATED)
    made.warmup()
    state = made.init(seed=1, recording=arguments.out)
    while state.time < arguments.duration:
        state = made.run(state)
    made.stop()
    print(made.get_record())


if __name__ == "__main__":
    main()
