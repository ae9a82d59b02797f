"""rex-lib's simulated clock: every event and message, one run."""

import time

import common

chosen = common.options(envs="1")

import jax
from rex.asynchronous import AsyncGraph
from rex.constants import Clock, LogLevel, RealTimeFactor
from rex.utils import set_log_level

import models
import rex_nodes

STEPS = 100  # of the supervisor in one measurement: a full episode takes seconds


def main():
    peer = f"rex-lib 0.0.12, jax {jax.__version__}"
    number = common.number("f32")
    model = models.PENDULUM
    nodes = rex_nodes.nodes(model, number)
    set_log_level(LogLevel.ERROR)
    graph = AsyncGraph(nodes, nodes["agent"], clock=Clock.SIMULATED, real_time_factor=RealTimeFactor.FAST_AS_POSSIBLE)
    actions = model.actions(1, number, common.STEPS + 2)
    params = {"agent": rex_nodes.Constants({k: v[:, 0] for k, v in actions.items()})}
    first = graph.init(jax.random.PRNGKey(0), params=params)
    graph.set_record_settings(params=True, rng=False, inputs=False, state=True, output=True)
    graph.warmup(first)
    seconds = []
    for _ in range(chosen.repeats):
        state, _ = graph.reset(first)
        for _ in range(10):
            state, _ = graph.step(state)
        start = time.perf_counter()
        for _ in range(STEPS):
            state, _ = graph.step(state)
        seconds.append(time.perf_counter() - start)
        graph.stop()
    common.throughput(peer, "pendulum, simulated clock", "f32", 1, STEPS, seconds)


main()
