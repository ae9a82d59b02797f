"""Ours on JAX: throughput, seconds from graph to first rollout, bytes of state for each environment.

The graphs are those of benches/throughput, which the native part of the bench reads, too. Environments that share a
schedule stand beside each other: the outer `vmap` is over schedules, the inner one over environments, so that what a
schedule says is read once for all of them.
"""

import time
from pathlib import Path

import common

chosen = common.options(dtypes="f32,f64")

import jax
import numpy as np
import parallax as px

import models

GRAPHS = Path(__file__).parent.parent / "throughput"
KEY = 0


class Pass:
    """A sensor or a motor's driver: passes the newest message on."""

    def __init__(self, source, first):
        self.source, self.first = source, first

    def init_params(self, key):
        return {}

    def init_state(self, key, params):
        return {}

    def init_output(self, key, params, state):
        return self.first

    def step(self, params, state, step):
        return state, step.inputs[self.source].latest.message


def compiled(model, seconds, episodes):
    """The graph along `episodes` schedules that are at least as long as `seconds`; the actions will be given."""
    graph = px.Graph(GRAPHS / f"{model.name}.toml")
    own = {node["name"] for node in graph.spec["node"] if node["kind"].startswith("throughput/")}
    sent = graph.model("world").init_output(jax.random.key(KEY), {}, {})
    action = dict.fromkeys(model.bounds, 0.0)
    nodes = {"sensor": Pass("world", sent), "agent": Pass("sensor", action), "motor": Pass("agent", action)}
    nodes = {name: node for name, node in nodes.items() if name in own}
    # A little more, so that late ends of steps do not take the last one away.
    result = graph.compile(graph.generate(seconds + 0.1, episodes, seed=1), nodes, pinned=["agent"])
    if result.lengths.min() < seconds * common.RATE:
        raise ValueError(f"an episode has {result.lengths.min()} steps only")
    return graph, result


def schedules(envs):
    """How many schedules so many environments run along: at least EPISODES where that divides them evenly."""
    return next((n for n in range(common.EPISODES, envs + 1) if envs % n == 0), 1)


def work(graph, model, envs, number):
    """Parameters, [schedule][environment], and actions, [step][schedule][environment]; of one environment, without."""
    shape = (schedules(envs), envs // schedules(envs)) if envs > 1 else ()
    start = graph.model("world").init_params(jax.random.key(KEY))
    drawn = model.parameters(envs, number)
    unknown = drawn.keys() - start[model.name].keys()
    if unknown:
        raise ValueError(f"the world has no parameters {sorted(unknown)}")
    params = jax.tree_util.tree_map(lambda leaf: np.full(shape, leaf, number), start)
    params[model.name] |= {k: v.reshape(shape) for k, v in drawn.items()}
    actions = {k: v.reshape(-1, *shape) for k, v in model.actions(envs, number).items()}
    return jax.device_put((params, actions))


def rollout(compiled, envs):
    """Parameters and actions of all environments, and the tables, to last states of the world."""

    def one(episode, params, actions, tables):
        state = compiled.init(jax.random.key(KEY), {"world": params}, episode)
        final, _ = compiled.rollout(state, common.STEPS, pinned={"agent": actions}, tables=tables)
        return final.state["world"]

    if envs == 1:
        return jax.jit(lambda params, actions, tables: one(0, params, actions, tables))
    inner = jax.vmap(one, (None, 0, 1, None))
    outer = jax.vmap(inner, (0, 0, 1, None))
    return jax.jit(lambda *given: outer(jax.numpy.arange(schedules(envs)), *given))


def main():
    peer = f"Parallax, jax {jax.__version__}"
    for model in models.MODELS:
        for dtype in chosen.dtype:
            jax.config.update("jax_enable_x64", dtype == "f64")
            number = common.number(dtype)
            first = time.perf_counter()
            graph, result = compiled(model, common.SECONDS, schedules(max(chosen.envs)))
            generated = time.perf_counter()
            jax.block_until_ready(rollout(result, 1)(*work(graph, model, 1, number), result.tables))
            if dtype == chosen.dtype[0]:
                common.value(
                    peer,
                    f"{model.name}, from graph to first rollout",
                    time.perf_counter() - first,
                    "s",
                    detail=f"{generated - first:.2f} s until the graph is compiled",
                )
                _, short = compiled(model, 10, 1)
                common.value(
                    peer, f"{model.name}, state per environment of 10 s", short.state_bytes(), "B", detail=dtype
                )
            for envs in chosen.envs:
                run = rollout(result, envs)
                given = (*work(graph, model, envs, number), result.tables)
                seconds = common.measure(lambda: jax.block_until_ready(run(*given)), chosen)
                common.throughput(
                    peer,
                    f"{model.name}, graph with delays",
                    dtype,
                    envs,
                    common.STEPS,
                    seconds,
                    episodes=schedules(envs),
                )


main()
