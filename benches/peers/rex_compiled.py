"""rex-lib's compiled graph: throughput, seconds from graph to first rollout, bytes of state for each environment."""

import contextlib
import io
import time

import common

chosen = common.options()

import jax
import jax.numpy as jnp
import numpy as np
from rex.artificial import generate_graphs
from rex.constants import Supergraph
from rex.graph import Graph

import models
import rex_nodes


def compiled(model, number, seconds):
    """The compiled graph over EPISODES generated schedules that are at least as long as `seconds`."""
    nodes = rex_nodes.nodes(model, number)
    graphs = generate_graphs(nodes, ts_max=seconds + 0.1, rng=jax.random.PRNGKey(0), num_episodes=common.EPISODES)
    with contextlib.redirect_stdout(io.StringIO()):
        return Graph(nodes, nodes["agent"], graphs, supergraph=Supergraph.MCS, progress_bar=False)


def starts(graph, model, envs, number):
    """Graph states of all environments, with parameters and schedules of their own; and actions [steps][envs]."""
    eps = jnp.arange(envs) % graph.max_eps
    constants = rex_nodes.Constants(model.parameters(envs, number))
    table = model.actions(envs, number, common.STEPS + 2)
    table = rex_nodes.Constants({k: v.T.copy() for k, v in table.items()})

    def start(eps, world, agent):
        params = {"world": world, "agent": agent}
        return graph.init(jax.random.PRNGKey(0), params=params, starting_eps=eps)

    states = jax.jit(jax.vmap(start))(eps, constants, table)
    return jax.block_until_ready(states), model.actions(envs, number)


def by_rollout(graph):
    """Graph.rollout; the agent looks its action up in a table."""
    return jax.jit(jax.vmap(lambda gs, _: graph.rollout(gs, max_steps=common.STEPS), in_axes=(0, -1)))


def by_step(graph):
    """Graph.reset and a scan over Graph.step, which is given the action: what a learner does."""

    def run(gs, us):
        # The table is not needed here: it would only make the carried state larger.
        gs = gs.replace(params=gs.params.copy({"agent": rex_nodes.Nothing()}))
        gs, ss = graph.reset(gs)

        def step(carry, u):
            gs, ss = carry
            return graph.step(gs, ss, rex_nodes.Values(u)), None

        return jax.lax.scan(step, (gs, ss), us)[0][0]

    return jax.jit(jax.vmap(run, in_axes=(0, -1)))


def state_bytes(graph, model, number):
    """Bytes that one environment carries from step to step, without the table of actions."""
    states, _ = starts(graph, model, 1, number)
    states = states.replace(params=states.params.copy({"agent": rex_nodes.Nothing()}))
    return sum(np.asarray(leaf).nbytes for leaf in jax.tree_util.tree_leaves(states))


def main():
    peer = f"rex-lib 0.0.12, jax {jax.__version__}"
    number = common.number("f32")
    for model in models.MODELS:
        first = time.perf_counter()
        graph = compiled(model, number, common.SECONDS)
        generated = time.perf_counter()
        states, actions = starts(graph, model, 1, number)
        jax.block_until_ready(by_rollout(graph)(states, actions))
        done = time.perf_counter()
        common.value(
            peer,
            f"{model.name}, from graph to first rollout",
            done - first,
            "s",
            detail=f"{generated - first:.1f} s until the graph is compiled",
        )
        if model is models.PENDULUM:
            amount = state_bytes(compiled(model, number, 10), model, number)
            common.value(peer, "pendulum, state per environment of 10 s", amount, "B")
        for dtype in chosen.dtype:
            if dtype != "f32":
                common.note(f"{peer}: {dtype} is not supported: rex-lib's own state is f32")
                continue
            for envs in chosen.envs:
                states, actions = starts(graph, model, envs, number)
                actions = jax.device_put(actions)
                for way, make in [("rollout", by_rollout), ("step", by_step)]:
                    run = make(graph)
                    seconds = common.measure(lambda: jax.block_until_ready(run(states, actions)), chosen)
                    common.throughput(
                        peer, f"{model.name}, graph with delays", dtype, envs, common.STEPS, seconds, way=way
                    )


main()
