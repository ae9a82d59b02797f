"""What is looked for in a recording of the pendulum, and how its pictures come to be seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..commands import CommandError
from ..recording import Recording
from ..types import Floats

__all__ = ["CAMERAS", "TERMS", "Seen", "specification"]

CAMERAS = {"camera": ("film", "mark"), "side": ("side_film", "side_mark")}
"""For each camera the nodes that take its pictures and look for the mark in them."""

SPECIFICATION = """\
# What is looked for in the recording: the constants of the dynamics, the first state, when a voltage acts, and which
# pixel of each camera belongs to which angle. Before both have seen the mark move there is nothing to compare.
format = 1
from = {begin:.3f}
hold_out = 0.2

[nodes.world]
kind = "pendulum/simulator"
rate = 100.0

# The detectors' places in the simulation: they tell where the mark is, without pictures.
[nodes.mark]
kind = "pendulum/detector-simulated"

[nodes.side_mark]
kind = "pendulum/detector-simulated"

[parameters]
"world.pendulum.inertia"  = {{ low = 8e-5, high = 3.2e-4, scale = "log", unit = "kg m^2", name = "J" }}
"world.pendulum.motor"    = {{ low = 0.015, high = 0.06, scale = "log", unit = "N m/A", name = "K" }}
"world.pendulum.damping"  = {{ low = 0.0, high = 1e-4, unit = "N m s/rad", name = "b" }}
"world.pendulum.friction" = {{ low = 0.0, high = 3e-3, unit = "N m", name = "c" }}

[initial]
"world.angle" = {{ low = 2.8, high = 3.5, unit = "rad" }}
"world.speed" = {{ low = -0.5, high = 0.5, unit = "rad/s" }}

[delays]
"motor -> world" = {{ max = 0.08, name = "actuator" }}

# From when a picture begins to be taken to when the mark is looked for in it, as the stamps tell.
[connections]
"world -> mark" = {mark:.6f}
"world -> side_mark" = {side_mark:.6f}

[outputs]
"""
"""The specification for `parallax identify`. Mass, length and resistance are known: only their combinations with the
others are determined by the motion."""

CLEAR = 1.5
"""Where the mark was at first is taken for the wall until it has been elsewhere: so long, s, it may be seen in part."""

TERMS = {"one": "1", "sin": "sin", "cos": "cos", "sin_sin": "sin_sin", "sin_cos": "sin_cos"}
"""The coefficients of a coordinate, and what each multiplies."""


@dataclass(frozen=True)
class Seen:
    """How pictures come to be seen, as the stamps of a recording tell."""

    begin: float
    """From when on all cameras see the whole mark, s."""
    lag: Mapping[str, float]
    """For each detector how long after a picture begins to be taken it looks for the mark there, s."""
    delay: tuple[float, float]
    """From when the front camera's picture begins to be taken to when its angle is told: mean and std, s."""

    @classmethod
    def of(cls, recording: Recording) -> Seen:
        """Of a run of the machine. Pictures are waited for, so that the steps of these nodes go together."""
        begin, lag = 0.0, {}
        for film, mark in CAMERAS.values():
            (seen,) = np.nonzero(recording[mark]["seen"])
            if not len(seen):
                raise CommandError(f"{mark} never saw the mark move: record for longer", 3)
            begin = max(begin, float(recording[mark].start[seen[0]]) + CLEAR)
            lag[mark] = float(np.mean(_after(recording[film].start, recording[mark].start)))
        told = _after(recording["film"].start, recording["camera"].end)
        return cls(begin, lag, (float(np.mean(told)), float(np.std(told))))


def _after(first: Floats, then: Floats) -> Floats:
    """How much later each of these times is."""
    both = min(len(first), len(then))
    later: Floats = then[:both] - first[:both]
    return later


def specification(seen: Seen) -> str:
    """The specification for `parallax identify`. The maps of the cameras enter linearly, and are solved for."""
    text = SPECIFICATION.format(begin=seen.begin, **seen.lag)
    for camera, (_, mark) in CAMERAS.items():
        for coordinate in ("u", "v"):
            terms = ", ".join(f'"{camera}.{coordinate}.{term}" = "{leaf}"' for term, leaf in TERMS.items())
            text += f'"{mark}.{coordinate}" = {{ linear = {{ {terms} }} }}\n'
    return text
