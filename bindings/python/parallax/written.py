"""Simulators in JAX written down as a `system.toml`, which the diagnosis, the estimator and the native batch read.

A function that gives the rates of change is unrolled into formulas (`parallax.symbolic`); from there on it is a system
like any other: effects act on its inputs, outputs, states and generalised forces, and its derivatives are exact.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from . import _native
from .symbolic import Expression, Formulas, formulas
from .system import Parameter
from .types import Tree

__all__ = ["Joint", "Reading", "write_system"]

TIME = "time"
"""The name of the seconds since the recording's start."""


@dataclass(frozen=True)
class Reading:
    """What one sensor reads."""

    signal: str | None = None
    """The recorded signal; without it, the one of the output's own name."""
    unit: str = ""
    """A label, the same as the signal's."""
    noise: float | None = None
    """Standard deviation of its noise, in `unit`; without it, a diagnosis estimates it."""
    wrap: float | None = None
    """Its period, where it is an angle."""


@dataclass(frozen=True)
class Joint:
    """Where forces may act that the simulator does not know."""

    position: str
    """Its position: a state, or an expression of states."""
    velocity: str
    """The state that is its velocity."""
    extra: Mapping[str, str] = field(default_factory=dict)
    """Other keys of the joint, such as `lever`, as expressions."""


def write_system(
    path: str | os.PathLike[str],
    *,
    name: str,
    derivative: Callable[[Tree, Tree, Tree, Tree], Mapping[str, Any]],
    state: Mapping[str, str | float | Parameter | None],
    output: Callable[[Tree, Tree, Tree], Mapping[str, Any]],
    outputs: Mapping[str, Reading],
    inputs: Mapping[str, str | None],
    parameters: Mapping[str, Parameter] | None = None,
    joints: Mapping[str, Joint] | None = None,
    drive: Callable[[Tree, Tree, Tree], Mapping[str, Any]] | None = None,
    load: Callable[[Tree, Tree], Mapping[str, Any]] | None = None,
    effects: Sequence[str] = (),
    comments: Sequence[str] = (),
) -> None:
    """Writes the simulator whose rates of change are `derivative` to `path`.

    All functions take dictionaries of scalars by name and return one. `derivative(parameters, state, inputs, forces)`
    gives the states' rates of change, per second; `forces` are the generalised forces of the motors by joint, where
    unknown ones add, and what gravity and friction do is its own. `output(parameters, state, inputs)` gives what the
    sensors read, `drive(parameters, state, inputs)` the motors' force of joints (those that it leaves out have none),
    `load(parameters, state)` the force of gravity or of another load, as `derivative` holds it already.

    `state` says where each state starts: a signal's name (its first sample), a number, one that is fitted for each
    recording between bounds (a `Parameter` with `calibrate`), or nothing. `inputs` names the
    recorded signal of each, or nothing where it is called the same. `effects` are `[[effect]]` tables as text;
    `comments` stand above everything.

    Raises `UntraceableError` when a function does what no formula does, such as a loop that ends by what it computes,
    and `ParallaxError` when what is written is no system, for instance for a name that is none.
    """
    parameters, joints = parameters or {}, joints or {}
    names = [*parameters, *state, *inputs, *(f"force_{joint}" for joint in joints)]
    double = sorted({one for one in names if names.count(one) > 1})
    if double:
        raise ValueError(
            f"the names {double} stand for two things; parameters, states and inputs need names of their own"
        )

    def symbols(of: Mapping[str, Any]) -> dict[str, np.ndarray[Any, Any]]:
        return {one: _scalar(Expression.symbol(one)) for one in of}

    p, x, u = symbols(parameters), symbols(state), symbols(inputs)
    forces = {joint: _scalar(Expression.symbol(f"force_{joint}")) for joint in joints}
    driven = _named("drive", formulas(drive, p, x, u) if drive else {}, joints, whole=False)
    loads = _named("load", formulas(load, p, x) if load else {}, joints, whole=False)
    rates = _named("derivative", formulas(derivative, p, x, u, forces), state)
    shown = _named("output", formulas(output, p, x, u), outputs)
    named = {
        **{f"drive_{joint}": value for joint, value in driven.items()},
        **{f"load_{joint}": value for joint, value in loads.items()},
        **{f"{one}.rate": value for one, value in rates.items()},
        **{f"{one}.shown": value for one, value in shown.items()},
    }
    texts = Formulas(named, [*names, TIME])
    lines = [f"# {comment}".rstrip() for comment in comments]
    lines += ["format = 1", f"name = {json.dumps(name)}", "", "[parameters]"]
    lines += [
        f"{one} = {_table(value=value.value, unit=value.unit or None, calibrate=value.calibrate)}"
        for one, value in parameters.items()
    ]
    lines += ["", "[inputs]", *(f"{one} = {_table(signal=signal or one)}" for one, signal in inputs.items())]
    lines += ["", "[let]"]
    for one in joints:
        lines += [f"{key} = {json.dumps(texts.texts[key])}" for key in (f"drive_{one}", f"load_{one}") if key in named]
        lines.append(f"force_{one} = {json.dumps(f'drive_{one}' if one in driven else '0')}")
    lines += [f"{part} = {json.dumps(text)}" for part, text in texts.parts.items()]
    lines += ["", "[state]"]
    for one, start in state.items():
        fitted = {"value": start.value, "calibrate": start.calibrate} if isinstance(start, Parameter) else start
        lines.append(f"{one} = {_table(derivative=texts.texts[f'{one}.rate'], initial=fitted)}")
    lines += ["", "[outputs]"]
    for one, reading in outputs.items():
        about = {"signal": reading.signal, "unit": reading.unit or None, "noise": reading.noise, "wrap": reading.wrap}
        lines.append(f"{one} = {_table(value=texts.texts[f'{one}.shown'], **about)}")
    lines += ["", "[joints]"]
    for one, joint in joints.items():
        parts = {"position": joint.position, "velocity": joint.velocity, "force": f"force_{one}"}
        parts |= {"drive": f"drive_{one}"} if one in driven else {}
        parts |= {"load": f"load_{one}"} if one in loads else {}
        lines.append(f"{one} = {_table(**parts, **joint.extra)}")
    for effect in effects:
        lines += ["", effect.strip()]
    Path(path).write_text("\n".join(lines) + "\n")
    _native.system(path, [])


def _scalar(value: Expression) -> np.ndarray[Any, Any]:
    block = np.empty((), object)
    block[()] = value
    return block


def _named(what: str, made: Mapping[str, Any], wanted: Mapping[str, Any], whole: bool = True) -> dict[str, Any]:
    """One formula by name."""
    unknown, missing = [one for one in made if one not in wanted], [one for one in wanted if one not in made]
    if unknown or (whole and missing):
        raise ValueError(f"{what} returns {list(made)}; it should return {list(wanted)}")
    values = {}
    for one, block in made.items():
        if np.shape(block) != ():
            raise ValueError(f"{what}: `{one}` has the shape {np.shape(block)}; one number is needed")
        value = np.asarray(block)[()]
        values[one] = value if isinstance(value, Expression) else float(value)
    return values


def _table(**entries: Any) -> str:
    """An inline table of what is given."""
    texts = (
        f"{key} = {_table(**value) if isinstance(value, dict) else json.dumps(value)}"
        for key, value in entries.items()
        if value is not None
    )
    return "{ " + ", ".join(texts) + " }"
