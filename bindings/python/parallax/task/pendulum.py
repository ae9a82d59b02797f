"""The pendulum's task (the paper's figure 8): record, identify, fit delays, train, run, tell."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..graph import Graph
from ..recording import Recording, load
from ..train import (
    PENDULUM,
    GraphEnvironment,
    PendulumSwingUp,
    Randomisation,
    Uniform,
    varied_episodes,
)
from ..types import Floats
from . import pendulum_graphs as graphs
from .page import figure, table, write_page
from .pendulum_identify import CAMERAS, TERMS, Seen, specification
from .poses import poses
from .work import STANDS, Options, Result, Work, chances, standing

__all__ = ["DEFAULTS", "VARIANTS", "Variant", "pendulum"]


@dataclass(frozen=True)
class Variant:
    """One way to train, and to see the machine in real time."""

    about: str
    """What it is, in words."""
    trained: str
    """The sensor of the simulator: `encoder` or `camera`."""
    delays: bool
    """Whether the simulator has the delays that were found."""
    past: tuple[int, int]
    """How many past observations and actions the policy sees."""
    runs_on: str
    """What it sees of the machine: `encoder`, `camera`, or the camera's filter, `predicted` or `filtered`."""

    @property
    def training(self) -> str:
        """Variants of the same name share a policy."""
        return f"{self.trained}-{'delays' if self.delays else 'ideal'}-{self.past[0]}-{self.past[1]}"


VARIANTS: dict[str, Variant] = {
    "full-state": Variant(
        "full state, trained without delays; runs on the shaft's encoder", "encoder", False, (0, 0), "encoder"
    ),
    "full-state-predicted": Variant(
        "the same policy; runs on the filter, which predicts to when a command acts",
        "encoder",
        False,
        (0, 0),
        "predicted",
    ),
    "full-state-filtered": Variant(
        "the same policy; runs on the filter without its prediction", "encoder", False, (0, 0), "filtered"
    ),
    "full-state-delays": Variant(
        "full state and past actions, trained with the delays; runs on the encoder", "encoder", True, (0, 6), "encoder"
    ),
    "camera": Variant("stacked camera angles, trained without delays", "camera", False, (4, 6), "camera"),
    "camera-delays": Variant("stacked camera angles, trained with the delays", "camera", True, (4, 6), "camera"),
}
"""What is compared."""


DEFAULTS = Options(
    out=Path("out/task/pendulum"), variants=tuple(VARIANTS), record=21.0, runs=3, run=10.0, steps=1_000_000
)
"""What is done unless told otherwise."""

DRAWN = 5
"""The most runs of a variant in the picture."""

TRUTHS = {"J": "inertia", "K": "motor", "b": "viscous", "c": "coulomb", "actuator": "delay"} | {
    name: name for name in (f"{camera}.{part}.{term}" for camera in CAMERAS for part in "uv" for term in TERMS)
}
"""What the machine calls what is identified."""


def pendulum(options: Options = DEFAULTS) -> Result:
    """Does the whole task; everything it writes is in `options.out`, the page is `report.html`."""
    work = Work("pendulum", options)
    excitation = work.out / "excitation.csv"
    _excitation(excitation, options.record, work.result.seed)
    work.record(graphs.recorded(), "--play", f"agent={excitation}")
    recorded = load(work.out / "recording.mcap")
    seen = Seen.of(recorded)
    work.identify(specification(seen))
    noise = _noise(work)
    chosen = {name: VARIANTS[name] for name in options.variants}
    for name in dict.fromkeys(variant.training for variant in chosen.values()):
        variant = next(variant for variant in chosen.values() if variant.training == name)
        environment = partial(_environment, work, seen, noise, variant)
        work.train(name, environment, PENDULUM.changed(total_steps=options.steps))

    ahead = _ahead(recorded) + work.estimate("actuator")["value"]
    filters = graphs.filters(work.identified, noise, ahead)
    traces: dict[str, list[tuple[Floats, Floats]]] = {}
    for name, variant in chosen.items():
        kind = "pendulum/camera-policy" if variant.runs_on == "camera" else "pendulum/policy"
        used = filters if variant.runs_on in filters else {}
        policy = str(work.policy(variant.training))
        spec = graphs.deployed(variant.runs_on, policy, kind, used, work.identified)
        shares: dict[str, list[Any]] = {"upright": [], "held": [], "back": []}
        errors: dict[str, list[tuple[float, float]]] = {each: [] for each in used}
        for number in range(options.runs):
            hands = _hands(number, options.run)
            recording = work.deploy(name, graphs.begun(spec, hands), number)
            for each in used:
                errors[each].append(_error(recording, each, ahead))
            time, angle, upright = _upright(recording)
            shares["upright"].append(float(np.mean(upright)))
            first = int(np.argmax(upright))
            shares["held"].append(float(np.mean(upright[first:])) if upright.any() else 0.0)
            shares["back"].append(_back(time, upright, hands))
            traces.setdefault(name, []).append((time, angle))
        means = {each: np.mean(pairs, axis=0).tolist() for each, pairs in errors.items()}
        work.result.variants[name] = {
            "about": variant.about,
            **shares,
            "standing": standing(shares["held"]),
            "errors": means,
        }
        every = ", ".join(f"{share:.0%}" for share in shares["held"])
        work.say(f"5. {name}: upright {np.mean(shares['upright']):.0%} of the time; after it first stood, {every}.")
        work.say(f"   {_stands(work.result.variants[name]['standing'])} it stood at least {STANDS:.0%} of that time.")

    result = work.finish()
    write_page(
        work,
        "The pendulum's task",
        TRUTHS,
        poses(work, recorded, seen),
        [
            "<p>Upright is within 10° and 0.5 rad/s. Each number is a run; the second counts from when it first "
            "stood, the third is how long after somebody tapped it, it was upright again. In the first run it hangs "
            "still and nobody taps it; in each other one it begins somewhere else, the same for every variant.</p>",
            _variants(result),
            "<p>The filter's mean square error against the machine at the time at which what follows from the estimate "
            f"acts, {1e3 * ahead:.1f} ms after the start of its step.</p>",
            _errors(result),
            _traces(traces),
        ],
    )
    return result


def _excitation(path: Path, seconds: float, seed: int) -> None:
    """A sum of sines that comes and goes, for swings well above the shaft: where a camera has seen no mark, its map is
    a guess. Over the top, little decides how a pendulum goes on."""
    random = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 0.02)
    frequencies = np.array([0.31, 0.57, 0.97, 1.61, 2.43, 3.37])
    phases = random.uniform(0, 2 * math.pi, len(frequencies))
    waves = np.sin(2 * math.pi * np.outer(time, frequencies) + phases).sum(axis=1)
    voltage = np.clip(0.9 * (0.6 + 0.4 * np.sin(2 * math.pi * time / 7.0)) * waves, -4.0, 4.0)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["time", "agent.voltage"])
        writer.writerows([f"{t:.6f}", f"{u:.6f}"] for t, u in zip(time, voltage, strict=True))


def _hands(number: int, seconds: float) -> dict[str, Any]:
    """What people do with the machine in a run: how they let go of it, and a tap after half of the time. Equal for all
    variants, and nothing in the first run. A tap of 1.6e-4 N m s changes the speed by about 1 rad/s."""
    if number == 0:
        return {}
    random = chances(number)
    tap = float(random.choice([-1.0, 1.0]) * random.uniform(1.6e-4, 6.4e-4))
    return {
        "angle": float(random.uniform(-math.pi, math.pi)),
        "speed": float(random.uniform(-2.0, 2.0)),
        "taps": [{"time": float(random.uniform(0.5, 0.7) * seconds), "impulse": tap}],
    }


def _back(time: Floats, upright: Any, hands: Mapping[str, Any]) -> float | None:
    """How long after the last tap it stood again, and for a quarter of a second, s; none where nobody tapped it or it
    never did."""
    taps = hands.get("taps", [])
    if not taps:
        return None
    last = max(tap["time"] for tap in taps)
    step = float(np.median(np.diff(time)))
    enough = max(1, round(0.25 / step))
    runs = np.convolve(upright.astype(float), np.ones(enough), mode="valid") >= enough - 0.5
    stands = np.flatnonzero(runs & (time[: len(runs)] > last))
    return float(time[stands[0]] - last) if len(stands) else None


def _noise(work: Work) -> float:
    """The noise of the front camera's angle, rad: that of the mark's place by how far the mark moves for a radian."""
    errors = {each["output"]: each["fitted"] for each in work.result.identified["outputs"]}
    noise = math.hypot(errors["mark.u"], errors["mark.v"])
    moves = [work.estimate(f"camera.{part}.{term}")["value"] for part in "uv" for term in ("sin", "cos")]
    return noise / math.hypot(*moves)


def _environment(work: Work, seen: Seen, noise: float, variant: Variant) -> GraphEnvironment:
    """What a variant is trained on: what was found."""
    spec = graphs.simulated(work.identified, work.fitted, seen, noise, variant.trained, variant.delays)
    graph = Graph(spec)
    shows = {"world": ("angle", "speed"), "encoder": ("angle", "speed"), "camera": ("angle",)}
    camera = variant.trained == "camera"
    observed = ("cos(angle)", "sin(angle)") if camera else ("cos(angle)", "sin(angle)", "speed")
    task = PendulumSwingUp(observations=observed, messages=shows)
    episodes: Any = 64
    if variant.delays:
        # The hidden delay as it was identified; the others by a millisecond.
        episodes = varied_episodes(
            graph, task.seconds + 2.2, identified=work.out / "identify", extra={"agent": Uniform(0.0, 1e-3)}
        )
    return GraphEnvironment(
        graph,
        task,
        episodes=episodes,
        past_observations=variant.past[0],
        past_actions=variant.past[1],
        randomisation=Randomisation.identified(work.out / "identify", widen=2.0),
    )


def _upright(recording: Recording) -> tuple[Floats, Floats, Any]:
    """Times (s), the angle from upright (rad, within ±π), and whether it stood: within 10° and 0.5 rad/s."""
    world = recording["world"]
    angle, speed = np.angle(np.exp(1j * world["angle"])), world["speed"]
    return world.sent, angle, (np.abs(angle) < math.radians(10)) & (np.abs(speed) < 0.5)


def _ahead(recording: Recording) -> float:
    """How long it took on average from the start of an estimator's step to the motor's command that followed, s."""
    estimator, agent, motor = (recording[name] for name in ("estimator", "agent", "motor"))
    seen = agent.inputs["estimator"].seq[:, -1]
    # The first of the motor's steps that saw each of the agent's messages.
    sent, first = np.unique(motor.inputs["agent"].seq[:, -1], return_index=True)
    command = dict(zip(sent.tolist(), motor.sent[first].tolist(), strict=True))
    began = dict(zip(estimator.step_seq.tolist(), estimator.start.tolist(), strict=True))
    pairs = zip(agent.step_seq.tolist(), seen.tolist(), strict=True)
    took = [command[own] - began[estimate] for own, estimate in pairs if own in command and estimate in began]
    return float(np.mean(took))


def _error(recording: Recording, name: str, ahead: float) -> tuple[float, float]:
    """Mean square errors of a filter's angle (rad²) and speed (rad²/s²) against the machine when a command acts."""
    world, own = recording["world"], recording[name]
    # The first second is the filter's own: it begins unsure.
    counts = (own.start > 1.0) & (own.start + ahead < world.sent[-1])
    acts = own.start[counts] + ahead
    angle, speed = (own[leaf][: len(own.start)][counts] for leaf in ("angle", "speed"))
    wrong = np.angle(np.exp(1j * (angle - np.interp(acts, world["stamp"], world["angle"]))))
    slow = speed - np.interp(acts, world["stamp"], world["speed"])
    return float(np.mean(wrong**2)), float(np.mean(slow**2))


def _errors(result: Result) -> str:
    """The paper's table 2."""
    rows = [
        [name, estimate, f"{angle:.2e} rad²", f"{speed:.2e} rad²/s²"]
        for name, told in result.variants.items()
        for estimate, (angle, speed) in told["errors"].items()
    ]
    return table(["runs of", "estimate", "angle", "speed"], rows)


def _variants(result: Result) -> str:
    shares = [
        [
            name,
            told["about"],
            _several(told["upright"], "{:.0%}"),
            _several(told["held"], "{:.0%}"),
            _several([math.inf if late is None else late for late in told["back"][1:]], "{:.2f} s"),
            _stands(told["standing"]),
        ]
        for name, told in result.variants.items()
    ]
    return table(
        ["variant", "", "upright", "after it first stood", "after a tap", f"{STANDS:.0%} of that, or more"], shares
    )


def _several(values: Sequence[float], form: str) -> str:
    """Few values one by one, many by their median, least and most."""

    def word(value: float) -> str:
        return "never" if math.isinf(value) else form.format(value)

    if len(values) <= 5:
        return ", ".join(map(word, values))
    ordered = sorted(values)
    return f"{word(ordered[len(ordered) // 2])} ({word(ordered[0])} to {word(ordered[-1])})"


def _stands(told: Mapping[str, Any]) -> str:
    """In how many runs it stood."""
    low, high = told["interval"]
    return f"in {told['runs']} of {told['of']} runs (95 %: {low:.0%} to {high:.0%})"


def _traces(traces: Mapping[str, list[tuple[Floats, Floats]]]) -> str:
    """The angle in the runs of each variant, the first one in front."""

    def draw(picture: Any) -> None:
        every = np.atleast_1d(picture.subplots(len(traces), 1, sharex=True))
        for axes, (name, runs) in zip(every, traces.items(), strict=True):
            for number, (time, angle) in reversed(list(enumerate(runs[:DRAWN]))):
                # A line across the picture where the angle wraps would be no motion.
                jumps = np.abs(np.diff(angle, append=angle[-1])) > np.pi
                look = {"linewidth": 0.8} if number == 0 else {"linewidth": 0.5, "color": "0.6"}
                axes.plot(time, np.where(jumps, np.nan, np.degrees(angle)), **look)
            axes.set_ylim(-190, 190)
            axes.set_yticks([-180, 0, 180])
            axes.set_title(name, fontsize=9, loc="left")
            axes.grid(alpha=0.3)
        every[-1].set_xlabel("s")
        picture.supylabel("degrees from upright", fontsize=9)

    return figure((8, 1.5 * len(traces)), draw)
