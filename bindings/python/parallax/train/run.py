"""A training from its first update to its files: progress, log, curves, checkpoints, policies."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..types import Array, Tree
from . import checkpoint
from .curves import plot_curves
from .environment import EnvironmentParams, GraphEnvironment
from .missing import package
from .policy import Policy
from .ppo import OBSERVATION_CLIP, PENDULUM, PPO, Learner, TrainState

__all__ = ["Training", "train"]

Row = dict[str, Any]
"""One line of the log: `steps` (of environments, for each seed), `seconds`, and lists with a number for each seed."""

EVALUATION = 0x6576616C
"""Keys of evaluations are folded with this: every evaluation starts from the same states."""


@dataclass
class Training:
    """What a training came to."""

    policies: list[Policy]
    """One for each seed."""
    seeds: list[int]
    """The seeds."""
    rows: list[Row]
    """The curves."""
    state: TrainState
    """Everything, `[seed, ...]`."""
    finished: bool
    """Whether all updates were made."""
    folder: Path | None = None
    """Where its files are."""

    @property
    def best(self) -> Policy:
        """The policy of the seed with the highest return at last."""
        return self.policies[int(np.argmax(self.rows[-1]["return"]))]

    @property
    def steps_per_second(self) -> float:
        """Steps of environments a second, over all seeds, without evaluations and compilation."""
        spent = sum(row["updating"] for row in self.rows[1:])
        counted = self.rows[-1]["steps"] - self.rows[0]["steps"]
        return float(counted * len(self.seeds) / spent) if spent > 0 else 0.0


def train(
    environment: GraphEnvironment,
    settings: PPO = PENDULUM,
    *,
    seeds: Sequence[int] = (0,),
    folder: str | os.PathLike[str] | None = None,
    resume: bool = False,
    evaluations: int = 20,
    evaluation_episodes: int = 32,
    progress: bool | None = None,
    stop: Callable[[Row], bool] | None = None,
) -> Training:
    """Trains one policy for each seed, all of them at once.

    A number of updates is one compiled function; between two of them the policies are evaluated (`evaluations` times
    over the training, on `evaluation_episodes` whole episodes, without noise on their actions). `folder` then holds
    `log.jsonl` (a line for each evaluation), `curves.svg`, `checkpoint.safetensors`, `policy-SEED.safetensors`, and
    `policy.safetensors`, that of the seed with the highest return. With `resume`, a training that was interrupted in
    the same folder goes on, bit for bit as if it had not been; one that has not begun there begins.

    `progress` shows a bar; without it, one is shown where a person may be looking. `stop` sees every line of the log
    and says whether that is enough. Ctrl-C ends the training at the last evaluation, whose state is kept.
    """
    place = None if folder is None else Path(folder)
    learner = Learner(environment, settings)
    params = environment.default_params
    many = _Many(learner, list(seeds), evaluation_episodes)
    about: Row = {"settings": settings.as_dict(), "seeds": list(seeds), "environment": fingerprint(environment)}
    kept = None if place is None else place / "checkpoint.safetensors"
    rows: list[Row] = []
    if resume and kept is not None and kept.exists():
        earlier = checkpoint.read_about(kept)
        _check(earlier, about, kept)
        state = checkpoint.read(kept, jax.eval_shape(many.init, params))
        rows = earlier["rows"]
    else:
        state = many.init(params)
    if place is not None:
        place.mkdir(parents=True, exist_ok=True)

    done = int(jnp.ravel(state.update)[0])
    chunk = max(1, -(-settings.updates // evaluations))
    bar = _bar(settings, done, progress)
    try:
        if not rows:
            rows.append(many.row(state, params, 0.0, 0.0, {}))
            _write(place, kept, state, about, rows)
        while done < settings.updates:
            started = time.perf_counter()
            # Up to the next whole chunk, so that a training with other evaluations goes on at the same places.
            count = min(chunk - done % chunk, settings.updates - done)
            after, sums = many.advance(state, count, params)
            jax.block_until_ready(after)  # type: ignore[no-untyped-call]
            updating = time.perf_counter() - started
            means = {name: value / count for name, value in sums.items()}
            row = many.row(after, params, rows[-1]["seconds"], updating, means)
            row["seconds"] += time.perf_counter() - started
            state, done = after, done + count
            rows.append(row)
            _write(place, kept, state, about, rows)
            bar.update(count * settings.batch)
            bar.set_postfix_str(_said(row), refresh=False)
            if stop is not None and stop(row):
                break
    except KeyboardInterrupt:
        # The state is that of the last evaluation, which was written.
        pass
    finally:
        bar.close()
    policies = many.policies(state)
    training = Training(policies, list(seeds), rows, state, done >= settings.updates, place)
    if place is not None:
        for seed, policy in zip(seeds, policies, strict=True):
            policy.save(place / f"policy-{seed}.safetensors")
        training.best.save(place / "policy.safetensors")
    return training


class _Many:
    """A learner for several seeds, compiled."""

    def __init__(self, learner: Learner, seeds: list[int], episodes: int) -> None:
        if not seeds or len(set(seeds)) != len(seeds):
            raise ValueError(f"the seeds {seeds} must be different, and at least one")
        self.learner = learner
        self.seeds = seeds
        self.episodes = episodes
        self._init = jax.jit(jax.vmap(learner.init, (0, None)))
        self._advance = jax.jit(self._updates)
        self._judge = jax.jit(jax.vmap(self._evaluate, (0, None)))

    def init(self, params: EnvironmentParams) -> TrainState:
        keys = jnp.stack([jax.random.key(seed) for seed in self.seeds])
        return self._init(keys, params)

    def advance(self, state: TrainState, count: int, params: EnvironmentParams) -> tuple[TrainState, Tree]:
        """`count` updates of every seed, and the sums of what they tell."""
        return self._advance(state, jnp.asarray(count, jnp.int32), params)

    def _updates(self, state: TrainState, count: Array, params: EnvironmentParams) -> tuple[TrainState, Tree]:
        update = jax.vmap(self.learner.update, (0, None))
        if len(self.seeds) == 1:
            # A batch of one matrix is no matrix to XLA on a CPU.
            update = _alone(self.learner.update)
        shapes = jax.eval_shape(update, state, params)[1]
        sums = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

        def body(_: Array, carry: tuple[TrainState, Tree]) -> tuple[TrainState, Tree]:
            state, seen = update(carry[0], params)
            return state, jax.tree.map(jnp.add, carry[1], seen)

        return lax.fori_loop(0, count, body, (state, sums))

    def _evaluate(self, state: TrainState, params: EnvironmentParams) -> dict[str, Array]:
        key = jax.random.fold_in(state.key, EVALUATION)
        return self.learner.evaluate(state, key, params, self.episodes)

    def row(self, state: TrainState, params: EnvironmentParams, seconds: float, updating: float, sums: Tree) -> Row:
        """A line of the log."""
        steps = int(jnp.ravel(state.update)[0]) * self.learner.settings.batch
        row: Row = {"steps": steps, "seconds": seconds, "updating": updating}
        for name, values in self._judge(state, params).items():
            row[name] = np.asarray(values, float).tolist()
        sums = {name: np.asarray(values, float) for name, values in sums.items()}
        if sums:
            ended = np.maximum(sums.pop("episodes"), 1e-9)
            row["train"] = {
                "return": (sums.pop("return") / ended).tolist(),
                "length": (sums.pop("length") / ended).tolist(),
                **{name: values.tolist() for name, values in sums.items()},
            }
        return row

    def policies(self, state: TrainState) -> list[Policy]:
        settings, interface = self.learner.settings, self.learner.environment.interface
        result = []
        for place in range(len(self.seeds)):
            own = jax.tree.map(lambda leaf, place=place: leaf[place], (state.network["actor"], state.seen))
            actor, seen = own
            mean, std = seen.mean, seen.std
            if not settings.normalise_observations:
                mean, std = jnp.zeros_like(mean), jnp.ones_like(std)
            clip = OBSERVATION_CLIP if settings.normalise_observations else float("inf")
            result.append(Policy.trained(interface, actor, settings.activation, settings.squash, mean, std, clip))
        return result


def _alone(update: Callable[..., Any]) -> Callable[..., Any]:
    def wrapped(state: Tree, params: EnvironmentParams) -> Any:
        result = update(jax.tree.map(lambda leaf: leaf[0], state), params)
        return jax.tree.map(lambda leaf: leaf[None], result)

    return wrapped


def fingerprint(environment: GraphEnvironment) -> dict[str, Any]:
    """What must be the same for a training to go on."""
    interface = environment.interface
    tables = hashlib.sha256()
    for table in environment.compiled.tables:
        tables.update(np.asarray(table).tobytes())
    return {
        "graph": hashlib.sha256(environment.graph.json().encode()).hexdigest(),
        "task": repr(environment.task),
        "inputs": interface.names,
        "actions": list(interface.actions),
        "randomised": environment.randomisation.places,
        "schedules": tables.hexdigest(),
    }


def _check(earlier: Mapping[str, Any], about: Mapping[str, Any], path: Path) -> None:
    found, wanted = json.loads(json.dumps([earlier, about]))
    settings = found["settings"]
    # Without annealing nothing depends on how long it will go on.
    free = () if wanted["settings"]["anneal"] else ("total_steps",)
    for name, value in wanted["settings"].items():
        if settings.get(name) != value and name not in free:
            raise checkpoint.CheckpointError(
                f"{path} is of a training with {name} = {settings.get(name)}, and this one has {value}"
            )
    for part in ("seeds", "environment"):
        if found[part] != wanted[part]:
            theirs, ours = found[part], wanted[part]
            if isinstance(theirs, dict):
                names = [name for name in ours if theirs.get(name) != ours[name]]
                part = f"environment ({', '.join(names)})"
            raise checkpoint.CheckpointError(f"{path} is of a training with another {part}")


def _write(place: Path | None, kept: Path | None, state: TrainState, about: Row, rows: list[Row]) -> None:
    if place is None or kept is None:
        return
    checkpoint.write(kept, state, {**about, "rows": rows})
    # The log is written whole, so that it never holds what a checkpoint does not.
    log = place / "log.jsonl"
    partial = log.with_name(log.name + ".part")
    partial.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    partial.replace(log)
    if len(rows) > 1:
        plot_curves({"": rows}, place / "curves.svg")


def _bar(settings: PPO, done: int, shown: bool | None) -> Any:
    tqdm = package("tqdm").tqdm
    return tqdm(
        total=settings.updates * settings.batch,
        initial=done * settings.batch,
        unit=" steps",
        unit_scale=True,
        desc="training",
        mininterval=0.5,
        file=sys.stderr,
        disable=not (sys.stderr.isatty() if shown is None else shown),
    )


def _said(row: Row) -> str:
    names = [name for name in row if name not in ("steps", "seconds", "updating", "train", "return_std")]
    return ", ".join(f"{name} {np.mean(row[name]):.3g}" for name in names)
