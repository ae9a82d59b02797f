"""A machine of Brax in a graph under the simulated clock, recorded for the diagnosis.

python examples/python/brax/pendulum.py --out out/brax.mcap
parallax diagnose --system examples/python/brax/system.toml out/brax.mcap --out out/brax
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import parallax as px
from parallax.worlds import BraxWorld

HERE = Path(__file__).resolve().parent
Tree = dict[str, Any]


class Encoder(px.Node):
    """The angle, with half a milliradian of noise."""

    def __init__(self, bias: float = 0.0, **settings: Any) -> None:
        """`bias` (rad) is what it shows at zero."""
        super().__init__(**settings)
        self._bias = bias

    def init_output(self, key: jax.Array, params: None, state: None) -> Tree:
        """It hangs."""
        return {"angle": jnp.asarray(0.0)}

    def step(self, params: None, state: None, step: px.Step) -> tuple[None, Tree]:
        """What the world shows."""
        angle = step["world"].latest.message["angle"]
        return state, {"angle": angle + self._bias + 5e-4 * step.noise(1)[0]}


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


def graph(model: str, bias: float = 0.0) -> px.Graph:
    """World, encoder, agent and motor; all send at once, so that only the machine's own ways are in the recording."""
    world = BraxWorld(
        model,
        commands={"motor.voltage": "drive"},
        outputs={"angle": "position:hinge", "speed": "velocity:hinge"},
        rate=100.0,
        name="world",
    )
    encoder = Encoder(bias=bias, rate=100.0)
    agent = Agent(rate=50.0)
    motor = px.RustNode("pendulum/motor", rate=100.0)
    world.connect(motor, skip=True)
    encoder.connect(world, block=True)
    agent.connect(encoder)
    motor.connect(agent)
    return px.Graph(
        agent,
        [world, encoder, agent, motor],
        clock=px.SIMULATED,
        name="brax-pendulum",
    )


def main() -> None:
    """Records a run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--out",
        default="out/brax.mcap",
        help="the recording to write (default: out/brax.mcap)",
    )
    parser.add_argument(
        "--duration", type=float, default=20.0, help="seconds (default: 20)"
    )
    arguments = parser.parse_args()
    Path(arguments.out).parent.mkdir(parents=True, exist_ok=True)
    print(
        graph(str(HERE / "pendulum.xml")).simulate(
            arguments.out, arguments.duration, seed=1
        )
    )


if __name__ == "__main__":
    main()
