"""Trains a policy to swing the simulated pendulum up, with its delays, and runs it under the simulated clock.

python examples/python/swing_up.py --out out/swingup            # a minute or two; --steps 200000 for a first look
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import parallax as px
from parallax import train as pt


def main() -> None:
    """Trains, saves, runs, and says for how much of the time the pendulum stood."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/swingup"))
    parser.add_argument(
        "--steps",
        type=int,
        default=pt.PENDULUM.total_steps,
        help="steps of environments",
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on where the training in --out was interrupted",
    )
    options = parser.parse_args()

    px.use_compilation_cache()
    environment = pt.GraphEnvironment(
        "pendulum-simulated",
        pt.PendulumSwingUp(),
        past_observations=1,
        past_actions=2,
        randomisation=pt.Randomisation(
            {
                "world.pendulum.mass": pt.Uniform(0.048, 0.054),
                "world.pendulum.friction": pt.Uniform(5e-4, 1.5e-3),
            }
        ),
    )
    settings = pt.PENDULUM.changed(total_steps=options.steps)
    training = pt.train(
        environment,
        settings,
        seeds=options.seeds,
        folder=options.out,
        resume=options.resume,
    )
    print(
        f"{training.steps_per_second:,.0f} steps a second; the log, the curves and the policies are in {options.out}"
    )

    # The policy's node in Rust in the agent's place.
    spec = px.Graph("pendulum-simulated").spec
    agent = next(node for node in spec["node"] if node["name"] == "agent")
    agent |= {
        "kind": "pendulum/policy",
        "parameters": {"file": str(options.out / "policy.safetensors")},
    }
    for edge in spec["connection"]:
        if edge["to"] == "agent":
            edge["port"] = "observation"
    recording = px.Graph(spec).simulate(options.out / "run.mcap", 10.0, seed=1)
    world = recording["world"]
    angle, speed = (
        world.payload[:, world.leaves.index(leaf)] for leaf in ("angle", "speed")
    )
    upright = (np.cos(angle) > np.cos(np.radians(10))) & (np.abs(speed) < 0.5)
    if upright.any():
        first = int(np.argmax(upright))
        print(
            f"upright after {world.sent[first]:.1f} s, and {upright[first:].mean():.1%} of the time from then on"
        )
    else:
        print("it never stood upright: train longer")


if __name__ == "__main__":
    main()
