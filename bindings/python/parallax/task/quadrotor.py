"""The quadrotor's task (the paper's figure 9 and table 3): flying circles, with and without delays in training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..graph import Graph
from ..recording import Recording
from ..train import QUADROTOR, GraphEnvironment, Normal, QuadrotorCircle, Randomisation, Uniform, varied_episodes
from ..train.randomisation import Distribution
from ..types import Floats
from . import quadrotor_graphs as graphs
from .page import figure, table, write_page
from .work import Options, Result, Work

__all__ = ["DEFAULTS", "VARIANTS", "Variant", "quadrotor"]

SETTLING = 3.0
"""What counts begins this long after the start of a run, s."""


@dataclass(frozen=True)
class Variant:
    """A circle, and how to train for it."""

    radius: float
    """Of the circle, m."""
    delays: bool
    """Whether the simulator has the delays that were found."""

    @property
    def about(self) -> str:
        """What it is, in words."""
        return f"a circle of {self.radius:g} m, trained {'with the' if self.delays else 'without'} delays"


VARIANTS: dict[str, Variant] = {
    f"{'delay' if delays else 'no-delay'}-{radius:g}": Variant(radius, delays)
    for radius in (1.0, 0.75, 0.5)
    for delays in (True, False)
}
"""What is compared."""

DEFAULTS = Options(
    out=Path("out/task/quadrotor"), variants=tuple(VARIANTS), record=15.0, runs=1, run=13.0, steps=1_500_000
)
"""What is done unless told otherwise."""

TRUTHS = {"gain": "attitude_gain", "time": "attitude_time"} | {
    name: name for name in ("mass", "drag_xy", "drag_z", "actuator", "feedback", "sensor")
}
"""What the machine calls what is identified."""


def quadrotor(options: Options = DEFAULTS) -> Result:
    """Does the whole task; everything it writes is in `options.out`, the page is `report.html`."""
    work = Work("quadrotor", options)
    work.record(graphs.recorded())
    work.identify(graphs.IDENTIFY)
    chosen = {name: VARIANTS[name] for name in options.variants}
    paths: dict[str, dict[str, Floats]] = {}
    for name, variant in chosen.items():
        work.train(name, partial(_environment, work, variant), QUADROTOR.changed(total_steps=options.steps))
    for name, variant in chosen.items():
        policy = str(work.policy(name))
        # Finer ticks than in training, where what is sensed lies between ticks.
        spec = graphs.simulated(
            work.identified, work.fitted, variant.delays, policy=policy, radius=variant.radius, rate=500.0
        )
        told: dict[str, Any] = {"about": variant.about, "radius": variant.radius, "delays": variant.delays}
        simulated = work.simulate(name, spec)
        told["simulated_speed"], told["simulated_error"] = _followed(simulated, variant.radius)
        flights = [
            work.deploy(name, graphs.deployed(policy, variant.radius, number), number) for number in range(options.runs)
        ]
        every = [_followed(flight, variant.radius) for flight in flights]
        told["speed"], told["error"] = ([float(pair[k]) for pair in every] for k in (0, 1))
        work.result.variants[name] = told
        paths[name] = {"simulated": _path(simulated), "real": _path(flights[0])}
        speeds = ", ".join(f"{speed:.2f} m/s, {1e3 * error:.0f} mm off" for speed, error in every)
        work.say(
            f"5. {name}: in simulation {told['simulated_speed']:.2f} m/s, {1e3 * told['simulated_error']:.0f} mm off; "
            f"on the machine {speeds}."
        )
    result = work.finish()
    write_page(
        work,
        "The quadrotor's task",
        TRUTHS,
        [],
        [
            f"<p>Means from {SETTLING:g} s on: speed along the circle, and distance from it. Each number of the "
            "machine is a run; each run after the first begins elsewhere on the circle, up to 0.15 m beside it.</p>",
            _table_3(result),
            _paths(paths, chosen),
        ],
    )
    return result


def _environment(work: Work, variant: Variant) -> GraphEnvironment:
    """What a variant is trained on: what was found."""
    graph = Graph(graphs.simulated(work.identified, work.fitted, variant.delays))
    task = QuadrotorCircle(radius=variant.radius)
    randomisation = Randomisation.identified(work.out / "identify", widen=2.0)
    if not variant.delays:
        return GraphEnvironment(graph, task, randomisation=randomisation)
    # The hidden delays as they were identified; the others by a millisecond. What is sensed is taken between two ticks,
    # as it was identified: its connections' own delays are not read.
    sensed = {place: work.estimate(name) for name, place in graphs.SENSED.items()}
    hidden: dict[str, Distribution] = {
        f"delays.{place}": Normal(found["value"], found["std"] or 0.0, low=0.0) for place, found in sensed.items()
    }
    episodes = varied_episodes(
        graph, task.seconds + 2.2, identified=work.out / "identify", extra={"agent": Uniform(0.0, 1e-3)}
    )
    return GraphEnvironment(
        graph,
        task,
        episodes=episodes,
        past_actions=4,
        randomisation=Randomisation(hidden, randomisation.joint),
        trainable={place: (0.0, max(0.05, 2 * found["value"])) for place, found in sensed.items()},
    )


def _followed(recording: Recording, radius: float) -> tuple[float, float]:
    """Mean speed along the circle (m/s), and mean distance from it (m): those of table 3."""
    world = recording["world"]
    counts = world.sent > SETTLING
    x, y, z = (world[f"position.{axis}"][counts] for axis in "xyz")
    vx, vy = (world[f"velocity.{axis}"][counts] for axis in "xy")
    distance = np.maximum(np.hypot(x, y), 1e-9)
    along = (vy * x - vx * y) / distance
    return float(np.mean(along)), float(np.mean(np.hypot(distance - radius, z - 1.0)))


def _path(recording: Recording) -> Floats:
    world = recording["world"]
    return np.stack([world["position.x"], world["position.y"]])[:, world.sent > SETTLING]


def _table_3(result: Result) -> str:
    rows = []
    for name, told in result.variants.items():
        speeds = ", ".join(f"{speed:.2f}" for speed in told["speed"])
        errors = ", ".join(f"{1e3 * error:.0f}" for error in told["error"])
        simulated = [f"{told['simulated_speed']:.2f}", f"{1e3 * told['simulated_error']:.0f}"]
        rows.append([name, *simulated, speeds, errors])
    return table(["variant", "simulation, m/s", "mm off", "machine, m/s", "mm off"], rows)


def _paths(paths: Mapping[str, Mapping[str, Floats]], chosen: Mapping[str, Variant]) -> str:
    """Seen from above: the paper's figure 9."""
    radii = sorted({variant.radius for variant in chosen.values()}, reverse=True)

    def draw(picture: Any) -> None:
        every = picture.subplots(2, len(radii), squeeze=False)
        for row, place in enumerate(("simulated", "real")):
            for axes, radius in zip(every[row], radii, strict=True):
                turn = np.linspace(0, 2 * np.pi, 200)
                axes.plot(radius * np.cos(turn), radius * np.sin(turn), "k--", linewidth=0.8)
                for name, variant in chosen.items():
                    if variant.radius == radius:
                        x, y = paths[name][place]
                        axes.plot(x, y, linewidth=0.8, label="delays" if variant.delays else "no delays")
                axes.set_aspect("equal")
                axes.set_xlim(-2 * radius, 2 * radius)
                axes.set_ylim(-2 * radius, 2 * radius)
                axes.set_title(f"{place}, R = {radius:g} m", fontsize=9, loc="left")
                axes.legend(fontsize=7, loc="upper right")

    return figure((3.2 * len(radii), 6.4), draw)
