"""A two-link arm in MJX, whose elbow has a friction that its own model does not know, recorded for the diagnosis.

python examples/python/mjx/arm.py --out out/arm.mcap
parallax new system --mjcf examples/python/mjx/arm.xml --out out/arm.toml \
    --signal turn=agent.turn --signal bend=agent.bend --signal shoulder=encoder.shoulder --signal elbow=encoder.elbow
parallax diagnose --system out/arm.toml out/arm.mcap --out out/arm
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import parallax as px
from parallax.worlds import MjxWorld

MODEL = Path(__file__).resolve().parent / "arm.xml"
Tree = dict[str, Any]


class Encoder(px.Node):
    """Both angles, with half a milliradian of noise."""

    def init_output(self, key: jax.Array, params: None, state: None) -> Tree:
        """It hangs."""
        return {"shoulder": jnp.asarray(0.0), "elbow": jnp.asarray(0.0)}

    def step(self, params: None, state: None, step: px.Step) -> tuple[None, Tree]:
        """What the world shows."""
        shown = step["world"].latest.message
        noise = 5e-4 * step.noise(2)
        return state, {"shoulder": shown["shoulder"] + noise[0], "elbow": shown["elbow"] + noise[1]}


class Agent(px.Node):
    """Torques of several frequencies at each joint, so that the motion shows everything."""

    def init_output(self, key: jax.Array, params: None, state: None) -> Tree:
        """No torque."""
        return {"turn": jnp.asarray(0.0), "bend": jnp.asarray(0.0)}

    def step(self, params: None, state: None, step: px.Step) -> tuple[None, Tree]:
        """Sines from 0.2 to 2.4 Hz."""
        turn = jnp.sin(2 * jnp.pi * jnp.array([0.2, 0.61, 1.3, 2.1]) * step.due + jnp.arange(4.0))
        bend = jnp.sin(2 * jnp.pi * jnp.array([0.27, 0.83, 1.7, 2.4]) * step.due + 2 * jnp.arange(4.0))
        return state, {"turn": 0.9 * jnp.sum(turn), "bend": 0.25 * jnp.sum(bend)}


def graph(model: str, friction: float) -> px.Graph:
    """World, encoder and agent; all send at once, so that only the machine's own ways are in the recording."""
    machine = model.replace('name="elbow"', f'name="elbow" frictionloss="{friction}"')
    world = MjxWorld(
        machine,
        commands={"agent.turn": "turn", "agent.bend": "bend"},
        outputs={"shoulder": "position:shoulder", "elbow": "position:elbow"},
        rate=100.0,
        name="world",
    )
    encoder = Encoder(rate=100.0)
    agent = Agent(rate=50.0)
    world.connect(agent, skip=True)
    encoder.connect(world, block=True)
    agent.connect(encoder)
    return px.Graph(agent, [world, encoder, agent], clock=px.SIMULATED, name="arm")


def main() -> None:
    """Records a run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="out/arm.mcap", help="the recording to write (default: out/arm.mcap)")
    parser.add_argument("--duration", type=float, default=20.0, help="seconds (default: 20)")
    parser.add_argument("--friction", type=float, default=0.08, help="the elbow's dry friction, N m (default: 0.08)")
    arguments = parser.parse_args()
    Path(arguments.out).parent.mkdir(parents=True, exist_ok=True)
    print(graph(MODEL.read_text(), arguments.friction).simulate(arguments.out, arguments.duration, seed=1))


if __name__ == "__main__":
    main()
