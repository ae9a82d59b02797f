"""The pendulum's task (the paper's figure 8): record, identify, fit delays, train, run, tell."""

from __future__ import annotations

import csv
import json
import math
import secrets
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..commands import Parallax
from ..graph import Graph
from ..recording import load
from ..train import (
    PENDULUM,
    GraphEnvironment,
    Normal,
    PendulumSwingUp,
    Randomisation,
    Training,
    Uniform,
    train,
    varied_episodes,
)
from ..train.randomisation import Distribution
from ..types import Floats
from . import graphs
from .report import write_report

__all__ = ["VARIANTS", "Options", "Result", "Variant", "pendulum"]

SECRET = "PARALLAX_HIDDEN_SEED"
"""The variable of the environment from which the world, and nothing else, draws what it is."""


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
    """What it sees of the machine: `encoder`, `camera` or `estimator`."""

    @property
    def training(self) -> str:
        """Variants of the same name share a policy."""
        return f"{self.trained}-{'delays' if self.delays else 'ideal'}-{self.past[0]}-{self.past[1]}"


VARIANTS: dict[str, Variant] = {
    "full-state": Variant(
        "full state, trained without delays; runs on the shaft's encoder", "encoder", False, (0, 0), "encoder"
    ),
    "full-state-estimated": Variant(
        "the same policy; runs on the estimator, which predicts to the present", "encoder", False, (0, 0), "estimator"
    ),
    "full-state-delays": Variant(
        "full state and past actions, trained with the delays; runs on the encoder", "encoder", True, (0, 6), "encoder"
    ),
    "camera": Variant("stacked camera angles, trained without delays", "camera", False, (4, 6), "camera"),
    "camera-delays": Variant("stacked camera angles, trained with the delays", "camera", True, (4, 6), "camera"),
}
"""What is compared. One with a filter that predicts to when a command acts belongs here, too."""


@dataclass(frozen=True)
class Options:
    """What to do."""

    out: Path = Path("out/task/pendulum")
    """The folder for everything."""
    seed: int | None = None
    """Which machine; none: drawn."""
    record: float = 21.0
    """How long to record, s."""
    runs: int = 3
    """Real-time runs of each variant."""
    run: float = 10.0
    """How long each lasts, s."""
    steps: int = 1_000_000
    """Steps of environments of each training."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Which of `VARIANTS`."""
    parallax: str | None = None
    """The command line."""
    say: Callable[[str], None] = print
    """Gets a line for everything that is done."""


@dataclass
class Result:
    """What came out."""

    seed: int
    """The machine's."""
    identified: dict[str, Any]
    """As `parallax identify` wrote it."""
    truth: dict[str, float]
    """What the machine was, asked for when all was done."""
    variants: dict[str, dict[str, Any]] = field(default_factory=dict)
    """For each variant, one number a run: the `upright` share of the time, and the share `held` after it first was."""
    training: dict[str, dict[str, float]] = field(default_factory=dict)
    """For each training its `seconds`, `steps_per_second`, `return` and share of time `upright` in simulation."""

    def as_dict(self) -> dict[str, Any]:
        """For a file."""
        names = ("seed", "identified", "truth", "variants", "training")
        return {name: getattr(self, name) for name in names}


def pendulum(options: Options) -> Result:
    """Does the whole task; everything it writes is in `options.out`, the page is `report.html`."""
    parallax, out, say = Parallax(options.parallax), options.out, options.say
    out.mkdir(parents=True, exist_ok=True)
    seed = secrets.randbelow(2**31) if options.seed is None else options.seed
    # Only the world reads it; neither a recording nor any later step of the task knows what it means.
    secret = {SECRET: f"machine {seed}"}

    say(f"1. Recording {options.record:g} s of a machine that nobody has measured (seed {seed}).")
    _excitation(out / "excitation.csv", options.record, seed)
    (out / "machine.toml").write_text(Graph(graphs.recorded()).toml(), encoding="utf-8")
    play = f"agent={out / 'excitation.csv'}"
    recording = out / "recording.mcap"
    length = f"{options.record}"
    parallax("run", out / "machine.toml", "--play", play, "--duration", length, "--out", recording, secret=secret)

    say("2. Identifying its constants and when a voltage acts, from the recording.")
    (out / "identify.toml").write_text(graphs.IDENTIFY, encoding="utf-8")
    parallax("identify", recording, "--spec", out / "identify.toml", "--out", out / "identify")
    identified = json.loads((out / "identify" / "identified.json").read_text(encoding="utf-8"))
    for estimate in identified["estimates"]:
        low, high = estimate["interval"]
        say(f"   {estimate['name']} = {estimate['value']:.4g} {estimate['unit']} ({low:.4g} to {high:.4g})")

    say("3. Fitting the delays that the stamps show.")
    delays = json.loads(
        parallax("delays", recording, "--out", out / "fitted.toml", "--plot", out / "delays.html", "--json")
    )

    chosen = {name: VARIANTS[name] for name in options.variants}
    result = Result(seed, identified, {})
    policies: dict[str, Path] = {}
    for name in dict.fromkeys(variant.training for variant in chosen.values()):
        variant = next(variant for variant in chosen.values() if variant.training == name)
        say(f"4. Training {name}.")
        training = _trained(options, variant, out)
        policies[name] = out / "training" / name / "policy.safetensors"
        last = training.rows[-1]
        result.training[name] = {
            "seconds": last["seconds"],
            "steps_per_second": training.steps_per_second,
            "return": float(np.max(last["return"])),
            "upright": float(last["upright"][int(np.argmax(last["return"]))]),
        }
        told = result.training[name]
        say(f"   {told['seconds']:.0f} s; upright {told['upright']:.0%} of an episode in simulation")

    traces: dict[str, tuple[Floats, Floats]] = {}
    for name, variant in chosen.items():
        kind = "pendulum/camera-policy" if variant.runs_on == "camera" else "pendulum/policy"
        spec = graphs.deployed(variant.runs_on, str(policies[variant.training]), kind)
        graph = out / "runs" / f"{name}.toml"
        graph.parent.mkdir(exist_ok=True)
        graph.write_text(Graph(spec).toml(), encoding="utf-8")
        shares: dict[str, list[float]] = {"upright": [], "held": []}
        for number in range(options.runs):
            path = out / "runs" / f"{name}-{number}.mcap"
            parallax("run", graph, "--duration", f"{options.run}", "--out", path, "--seed", f"{number}", secret=secret)
            time, angle, upright = _upright(path)
            shares["upright"].append(float(np.mean(upright)))
            first = int(np.argmax(upright))
            shares["held"].append(float(np.mean(upright[first:])) if upright.any() else 0.0)
            traces.setdefault(name, (time, angle))
        result.variants[name] = {"about": variant.about, **shares}
        every = ", ".join(f"{share:.0%}" for share in shares["held"])
        say(f"5. {name}: upright {np.mean(shares['upright']):.0%} of the time; after it first stood, {every}.")

    result.truth = json.loads(parallax("task-machine", "--seed", f"{seed}"))
    (out / "task.json").write_text(json.dumps(result.as_dict(), indent=1), encoding="utf-8")
    write_report(out, result, delays, traces, {name: out / "training" / name for name in policies})
    say(f"   The report is {out / 'report.html'}")
    return result


def _excitation(path: Path, seconds: float, seed: int) -> None:
    """A sum of sines that comes and goes, strong enough for swings that stay below the top."""
    random = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 0.02)
    frequencies = np.array([0.31, 0.57, 0.97, 1.61, 2.43, 3.37])
    phases = random.uniform(0, 2 * math.pi, len(frequencies))
    waves = np.sin(2 * math.pi * np.outer(time, frequencies) + phases).sum(axis=1)
    voltage = np.clip(0.55 * (0.6 + 0.4 * np.sin(2 * math.pi * time / 7.0)) * waves, -3.0, 3.0)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["time", "agent.voltage"])
        writer.writerows([f"{t:.6f}", f"{u:.6f}"] for t, u in zip(time, voltage, strict=True))


def _trained(options: Options, variant: Variant, out: Path) -> Training:
    """The training of a variant, on what was found."""
    identified, fitted = _toml(out / "identify" / "identified.toml"), _toml(out / "fitted.toml")
    graph = Graph(graphs.simulated(identified, fitted, variant.trained, variant.delays))
    shows = {"world": ("angle", "speed"), "encoder": ("angle", "speed"), "camera": ("angle",)}
    camera = variant.trained == "camera"
    seen = ("cos(angle)", "sin(angle)") if camera else ("cos(angle)", "sin(angle)", "speed")
    task = PendulumSwingUp(observations=seen, messages=shows)
    episodes: Any = 64
    if variant.delays:
        # As unsure as the identification is of the hidden delay; the others by a millisecond.
        (hidden,) = (
            e
            for e in json.loads((out / "identify" / "identified.json").read_text())["estimates"]
            if e["name"] == "actuator"
        )
        name = next(name for name in graph.connections if name.startswith("motor->world"))
        extra: dict[str, Distribution] = {name: Normal(0.0, hidden["std"] or 2e-3), "agent": Uniform(0.0, 1e-3)}
        episodes = varied_episodes(graph, task.seconds + 2.2, extra=extra, variants=16, each=4)
    environment = GraphEnvironment(
        graph,
        task,
        episodes=episodes,
        past_observations=variant.past[0],
        past_actions=variant.past[1],
        randomisation=Randomisation.identified(out / "identify", widen=2.0),
    )
    settings = PENDULUM.changed(total_steps=options.steps)
    return train(environment, settings, folder=out / "training" / variant.training, evaluations=10)


def _upright(path: Path) -> tuple[Floats, Floats, Any]:
    """Times (s), the angle from upright (rad, within ±π), and whether it stood: within 10° and 0.5 rad/s."""
    world = load(path)["world"]
    angle, speed = (world.payload[:, world.leaves.index(leaf)] for leaf in ("angle", "speed"))
    angle = np.angle(np.exp(1j * angle))
    return world.sent, angle, (np.abs(angle) < math.radians(10)) & (np.abs(speed) < 0.5)


def _toml(path: Path) -> Mapping[str, Any]:
    with path.open("rb") as file:
        return tomllib.load(file)
