"""What every task does with a machine: record, identify, fit delays, train, run, and ask at last what it was."""

from __future__ import annotations

import hashlib
import json
import math
import secrets
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from ..commands import CommandError, Parallax
from ..graph import Graph
from ..recording import Recording, load
from ..train import PPO, GraphEnvironment, train

__all__ = ["STANDS", "Options", "Result", "Work", "chances", "standing"]

SECRET = "PARALLAX_HIDDEN_SEED"
"""The variable of the environment from which the machine's processes, and nothing else, draw what it is."""
BEGUN = "begun.json"
"""What was begun in a folder, and what of it is done."""
STANDS = 0.9
"""A policy that holds for this share of the time has come over to the machine."""
LASTING = ("record", "run", "steps")
"""Options that stay as they are where a task is taken up again."""


@dataclass(frozen=True)
class Options:
    """What to do."""

    out: Path
    """The folder for everything."""
    variants: tuple[str, ...]
    """What is compared."""
    record: float
    """How long to record, s."""
    runs: int
    """Real-time runs of each variant."""
    run: float
    """How long each lasts, s."""
    steps: int
    """Steps of environments of each training."""
    seed: int | None = None
    """Which machine; none: drawn."""
    resume: bool = False
    """Whether what the folder holds already is not done again: more runs or other variants of the same machine."""
    real_time: bool = False
    """Whether the machine's processes, and those that control it, run before all ordinary programs."""
    parallax: str | None = None
    """The command line."""
    say: Callable[[str], None] = print
    """Gets a line for everything that is done."""


@dataclass
class Result:
    """What came out."""

    seed: int
    """The machine's."""
    identified: dict[str, Any] = field(default_factory=dict)
    """As `parallax identify` wrote it."""
    truth: dict[str, float] = field(default_factory=dict)
    """What the machine was, asked for when all was done."""
    variants: dict[str, dict[str, Any]] = field(default_factory=dict)
    """For each variant its `about`, and lists with a number for each run."""
    training: dict[str, dict[str, float]] = field(default_factory=dict)
    """For each training its `seconds`, `steps_per_second`, `return` and the task's own metrics, in simulation."""
    nodes: dict[str, dict[str, float]] = field(default_factory=dict)
    """For each node its `rate` (Hz) and how long its steps took: `mean` and `std`, s, and how `late` they began, s."""

    def as_dict(self) -> dict[str, Any]:
        """For a file."""
        return {each.name: getattr(self, each.name) for each in fields(self)}


class Work:
    """A machine and the folder in which everything about it is."""

    def __init__(self, task: str, options: Options) -> None:
        self.task = task
        self.options = options
        self.out, self.say = options.out, options.say
        self._parallax = Parallax(options.parallax)
        self.out.mkdir(parents=True, exist_ok=True)
        self._begun = self._taken_up() if options.resume else self._anew()
        seed = self._begun["seed"]
        # Only the machine reads it; neither a recording nor any later step of the task knows what it means.
        self._secret = {SECRET: f"machine {seed}"}
        self.result = Result(seed)
        self.delays: dict[str, Any] = {}
        """As `parallax delays` told them."""

    def _anew(self) -> dict[str, Any]:
        options = self.options
        seed = secrets.randbelow(2**31) if options.seed is None else options.seed
        return {
            "task": self.task,
            "seed": seed,
            **{name: getattr(options, name) for name in LASTING},
            "done": [],
            "training": {},
        }

    def _taken_up(self) -> dict[str, Any]:
        """What was begun in the folder, where that is the same."""
        path = self.out / BEGUN
        if not path.exists():
            raise CommandError(f"{path} is not there: nothing was begun in that folder; leave --resume out", 2)
        begun: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        asked = {name: getattr(self.options, name) for name in LASTING} | {"task": self.task}
        if self.options.seed is not None:
            asked["seed"] = self.options.seed
        for name, value in asked.items():
            if begun[name] != value:
                raise CommandError(
                    f"{path} was begun with {name} {begun[name]}, which cannot become {value}: state the same, or "
                    "another --out",
                    2,
                )
        return begun

    def _has(self, what: str) -> bool:
        """Whether an earlier call did this to its end."""
        return what in self._begun["done"]

    def _did(self, what: str) -> None:
        """Notes that it is done, so that it need not be done again."""
        self._begun["done"] = [*(each for each in self._begun["done"] if each != what), what]
        path = self.out / BEGUN
        whole = path.with_suffix(".new")
        whole.write_text(json.dumps(self._begun, indent=1), encoding="utf-8")
        whole.replace(path)

    def record(self, spec: Mapping[str, Any], *arguments: str | Path) -> None:
        """Runs the machine in real time as `recording.mcap`."""
        length = self.options.record
        if self._has("recording"):
            self.say(f"1. The recording of the machine is there (seed {self.result.seed}).")
            return
        self.say(f"1. Recording {length:g} s of a machine that nobody has measured (seed {self.result.seed}).")
        graph = self.written("machine", spec)
        recording = self.out / "recording.mcap"
        self._run(graph, recording, length, *arguments)
        self._did("recording")

    def identify(self, specification: str) -> None:
        """Identifies it, and fits the delays that the stamps show."""
        self.say("2. Identifying its constants and hidden delays, from the recording.")
        recording, specified = self.out / "recording.mcap", self.out / "identify.toml"
        if not self._has("identify"):
            specified.write_text(specification, encoding="utf-8")
            self._parallax("identify", recording, "--spec", specified, "--out", self.out / "identify")
            self._did("identify")
        found = json.loads((self.out / "identify" / "identified.json").read_text(encoding="utf-8"))
        self.result.identified = found
        for estimate in found["estimates"]:
            low, high = estimate["interval"]
            self.say(f"   {estimate['name']} = {estimate['value']:.4g} {estimate['unit']} ({low:.4g} to {high:.4g})")
        for note in found["not_written"]:
            self.say(f"   not in the identified graph: {note}")
        self.say("3. Fitting the delays that the stamps show.")
        fitted, page = self.out / "fitted.toml", self.out / "delays.html"
        self.delays = json.loads(self._parallax("delays", recording, "--out", fitted, "--plot", page, "--json"))
        self.result.nodes = node_statistics(load(recording))

    @property
    def identified(self) -> Mapping[str, Any]:
        """The graph with what was identified."""
        return _toml(self.out / "identify" / "identified.toml")

    @property
    def fitted(self) -> Mapping[str, Any]:
        """The recorded graph with the delays that were measured."""
        return _toml(self.out / "fitted.toml")

    def estimate(self, name: str) -> dict[str, Any]:
        """What was identified under this name."""
        found: dict[str, Any] = next(e for e in self.result.identified["estimates"] if e["name"] == name)
        return found

    def train(self, name: str, environment: Callable[[], GraphEnvironment], settings: PPO) -> None:
        """Trains in `training/NAME`."""
        if self._has(f"training {name}"):
            self.result.training[name] = self._begun["training"][name]
            self.say(f"4. The training {name} is there.")
            return
        self.say(f"4. Training {name}.")
        folder = self.out / "training" / name
        training = train(environment(), settings, folder=folder, evaluations=10, resume=self.options.resume)
        if not training.finished:
            raise KeyboardInterrupt
        rows = training.rows
        last, best = rows[-1], int(np.argmax(rows[-1]["return"]))
        names = [key for key, values in last.items() if isinstance(values, list) and key != "return_std"]
        told = {key: float(last[key][best]) for key in names}
        self.result.training[name] = {
            "seconds": last["seconds"],
            "steps_per_second": training.steps_per_second,
            **told,
        }
        self._begun["training"][name] = self.result.training[name]
        self._did(f"training {name}")
        self.say(f"   {last['seconds']:.0f} s; " + ", ".join(f"{key} {value:.3g}" for key, value in told.items()))

    def policy(self, name: str) -> Path:
        """The policy of a training."""
        return self.out / "training" / name / "policy.safetensors"

    def deploy(self, name: str, spec: Mapping[str, Any], number: int) -> Recording:
        """Runs a graph with a policy on the machine, in real time."""
        graph = self.written(f"runs/{name}-{number}", spec)
        path = graph.with_suffix(".mcap")
        # It is made again where its graph is another one: a filter may have got other parameters.
        what = f"{path.stem} of {hashlib.sha256(graph.read_bytes()).hexdigest()}"
        if not (self._has(what) and path.exists()):
            self._run(graph, path, self.options.run, "--seed", f"{number}")
            self._did(what)
        return load(path)

    def _run(self, graph: Path, out: Path, seconds: float, *arguments: str | Path) -> None:
        priority = ["--real-time"] if self.options.real_time else []
        words = ["run", graph, "--duration", f"{seconds}", "--out", out, *priority, *arguments]
        self._parallax(*words, secret=self._secret)

    def simulate(self, name: str, spec: Mapping[str, Any]) -> Recording:
        """Runs a graph under the simulated clock."""
        graph, path = self.written(f"simulated/{name}", spec), self.out / "simulated" / f"{name}.mcap"
        self._parallax("sim", graph, "--duration", f"{self.options.run}", "--out", path, "--seed", "0")
        return load(path)

    def written(self, name: str, spec: Mapping[str, Any]) -> Path:
        """A graph's file."""
        path = self.out / f"{name}.toml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(Graph(dict(spec)).toml(), encoding="utf-8")
        return path

    def finish(self) -> Result:
        """Asks what the machine was, and writes `task.json`."""
        told = self._parallax("task-machine", "--task", self.task, "--seed", f"{self.result.seed}")
        self.result.truth = json.loads(told)
        (self.out / "task.json").write_text(json.dumps(self.result.as_dict(), indent=1), encoding="utf-8")
        return self.result


def standing(shares: list[float]) -> dict[str, Any]:
    """In how many runs a share of the time is at least `STANDS`: `runs`, `of`, and the 95 % `interval` of that share of
    runs (E. B. Wilson, 1927)."""
    n, good, z = len(shares), sum(share >= STANDS for share in shares), 1.96
    p = good / n
    middle, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    interval = [max(0.0, (middle - half) / (1 + z * z / n)), min(1.0, (middle + half) / (1 + z * z / n))]
    return {"runs": good, "of": n, "interval": interval}


def chances(number: int) -> np.random.Generator:
    """What happens by chance in a run of this number: the same for every variant."""
    return np.random.default_rng([number, 0x7A9])


def node_statistics(recording: Recording) -> dict[str, dict[str, float]]:
    """The paper's table 4 of a run in real time: see `Result.nodes`."""
    rates = {node["name"]: float(node["rate"]) for node in recording.graph["node"]}
    statistics = {}
    for name, track in recording.nodes.items():
        took, late = track.end - track.start, track.start - track.due
        if len(took):
            statistics[name] = {
                "rate": rates[name],
                "mean": float(np.mean(took)),
                "std": float(np.std(took)),
                "late": float(np.mean(late)),
            }
    return statistics


def _toml(path: Path) -> Mapping[str, Any]:
    with path.open("rb") as file:
        return tomllib.load(file)
