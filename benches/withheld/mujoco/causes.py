"""What a machine may have and its file does not say, and how large."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from machines import Machine

Random = np.random.Generator


@dataclass(frozen=True)
class Cause:
    """What the machine has and its file does not say."""

    kind: str
    place: str
    parameters: dict[str, float] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """`kind@place`."""
        return f"{self.kind}@{self.place}"


def causes(machine: Machine) -> list[tuple[str, str]]:
    """Every kind at every place where it can be seen."""
    at = []
    for key in machine.inputs:
        kinds = ("delay", "lag", "gain", "offset", "saturation", "deadband", "rate_limit", "backlash")
        at += [(kind, f"input:{key}") for kind in kinds]
    for name, joint in machine.joints.items():
        kinds = ("viscous", "coulomb", "spring", "constant_force", "periodic_disturbance", "end_stop", "inertia")
        at += [(kind, f"joint:{name}") for kind in kinds]
        at += [("payload", f"joint:{name}")] * (joint.lever > 0)
        at += [("gravity_tilt", f"joint:{name}")] * joint.tilts
        at += [("flexibility", f"joint:{name}")] * joint.bends
    for name in machine.outputs:
        at += [(kind, f"output:{name}") for kind in ("delay", "sensor_lag", "bias", "scale", "drift")]
    at += [("parameter", f"parameter:{name}") for name, own in machine.parameters.items() if own.bounds is None]
    return [(kind, place) for kind, place in at if f"{kind}@{place}" not in machine.absorbed]


def draw(machine: Machine, kind: str, place: str, random: Random) -> Cause:
    """Magnitudes from ranges that engineers meet, relative to the machine's forces, speeds and ranges."""
    where, _, name = place.partition(":")
    low_high = random.uniform
    sign = random.choice([-1.0, 1.0])

    def logarithmic(low: float, high: float) -> float:
        return float(math.exp(low_high(math.log(low), math.log(high))))

    size = machine.inputs[name][2] if where == "input" else 1.0
    joint = machine.joints.get(name)
    if where == "output":
        size = list(machine.joints.values())[list(machine.outputs).index(name)].range
    values: dict[str, float] = {}
    match kind:
        case "delay":
            values = {"delay": logarithmic(0.005, 0.08)}
        case "lag":
            values = {"time_constant": logarithmic(0.01, 0.12)}
        case "sensor_lag":
            values = {"time_constant": logarithmic(0.01, 0.1)}
        case "gain":
            values = {"gain": low_high(0.6, 0.85) if sign < 0 else low_high(1.15, 1.5)}
        case "scale":
            values = {"scale": low_high(0.8, 0.96) if sign < 0 else low_high(1.04, 1.2)}
        case "offset":
            values = {"offset": sign * size * low_high(0.07, 0.5)}
        case "saturation":
            values = {"low": -size * low_high(0.7, 1.7), "high": size * low_high(0.7, 1.7)}
        case "deadband":
            values = {"width": size * low_high(0.07, 0.5)}
        case "rate_limit":
            values = {"rate": size * logarithmic(3.0, 30.0)}
        case "backlash":
            values = {"gap": size * low_high(0.1, 0.8)}
        case "bias":
            values = {"bias": sign * size * low_high(0.02, 0.12)}
        case "drift":
            values = {"rate": sign * size * low_high(0.002, 0.02)}
        case "parameter":
            values = {"value": machine.parameters[name].value * (1 + sign * low_high(0.15, 0.4))}
    if joint is not None:
        match kind:
            case "viscous":
                values = {"coefficient": joint.force / joint.speed * logarithmic(0.1, 0.8)}
            case "coulomb":
                values = {"force": joint.force * logarithmic(0.05, 0.5)}
            case "spring":
                stiffness = joint.force / joint.range * low_high(0.3, 1.2)
                values = {"stiffness": stiffness, "rest": joint.range * low_high(-0.3, 0.3)}
            case "constant_force":
                values = {"force": sign * joint.force * low_high(0.06, 0.4)}
            case "periodic_disturbance":
                amplitude = joint.force * low_high(0.06, 0.4)
                phase = low_high(-math.pi, math.pi)
                values = {"amplitude": amplitude, "frequency": low_high(0.5, 6.0), "phase": phase}
            case "end_stop":
                stiffness = joint.force / joint.range * logarithmic(30.0, 300.0)
                values = {"limit": joint.range * low_high(0.3, 0.9), "stiffness": stiffness}
            case "inertia":
                values = {"added": joint.inertia * low_high(0.2, 1.5)}
            case "payload":
                values = {"mass": joint.inertia / joint.lever**2 * low_high(0.15, 0.6)}
            case "gravity_tilt":
                values = {"angle": sign * low_high(0.03, 0.2)}
            case "flexibility":
                stiffness = joint.inertia * logarithmic(15.0, 55.0) ** 2
                damping = 2 * low_high(0.01, 0.08) * math.sqrt(stiffness * joint.inertia)
                values = {"stiffness": stiffness, "damping": damping, "ratio": low_high(0.2, 0.6)}
    return Cause(kind, place, {key: float(value) for key, value in values.items()})


ONE_SIDED = ("delay", "lag", "sensor_lag", "deadband", "backlash", "viscous", "coulomb", "inertia", "payload")
"""Kinds whose opposite is none."""


def scaled(machine: Machine, cause: Cause, factor: float) -> Cause:
    """The same cause, some factor (at most 30) further from where it does nothing, if there is such a place."""
    nothing = {"gain": 1.0, "scale": 1.0}.get(cause.kind, 0.0)
    if cause.kind == "parameter":
        nothing = machine.parameters[cause.place.partition(":")[2]].value
    if len(cause.parameters) > 1 or cause.kind == "rate_limit":
        return cause
    factor = math.copysign(min(max(abs(factor), 1 / 30), 30.0), factor)
    if cause.kind in ONE_SIDED:
        factor = abs(factor)
    if cause.kind in ("parameter", "gain", "scale"):
        # Masses and gains stay above nothing.
        (value,) = cause.parameters.values()
        if value == nothing:
            return cause
        factor = (
            max(factor, -0.8 * nothing / (value - nothing))
            if value > nothing
            else min(factor, 0.8 * nothing / (nothing - value))
        )
    return replace(
        cause, parameters={key: nothing + factor * (value - nothing) for key, value in cause.parameters.items()}
    )
