"""Steps of environments a second while PPO trains: the graph with its delays beside the pendulum's bare equations.

    python benches/training/speed.py [--updates 20] [--repeats 5] [--json]

Both run the paper's settings for the pendulum (128 environments, 32 steps, 8 epochs of 16 minibatches, 64×64), one
after the other in turns, in one process. The graph is `pendulum-simulated`: world and sensor at 100 Hz, agent and motor
at 50 Hz, with Gaussian delays of computation and communication along 64 schedules.
"""

import argparse
import json
import os
import platform
import statistics
import time

import jax
from jax import lax
from parallax import train as pt

import plain


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--updates", type=int, default=20, help="updates of one repetition")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--past", type=int, default=0, help="how much of the past the policy of the graph sees")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    settings = pt.PENDULUM
    task = pt.PendulumSwingUp()

    begin = time.perf_counter()
    environment = pt.GraphEnvironment(
        "pendulum-simulated", task, past_observations=options.past, past_actions=options.past
    )
    made = time.perf_counter() - begin
    learner = pt.Learner(environment, settings)
    params = environment.default_params
    ours = jax.jit(lambda s, p: lax.fori_loop(0, options.updates, lambda _, s: learner.update(s, p)[0], s))
    init, update = plain.learner(settings, environment.longest)
    theirs = jax.jit(lambda s: lax.fori_loop(0, options.updates, lambda _, s: update(s), s))

    contenders = {
        "graph with delays": (lambda s: ours(s, params), jax.jit(learner.init)(jax.random.key(0), params)),
        "bare equations": (theirs, jax.jit(init)(jax.random.key(0))),
    }
    compiled, states = {}, {}
    for name, (run, state) in contenders.items():
        begin = time.perf_counter()
        states[name] = jax.block_until_ready(run(state))
        compiled[name] = time.perf_counter() - begin
        # The types that come out may be stronger than those that went in: then it is compiled once more.
        states[name] = jax.block_until_ready(run(states[name]))
    rates = {name: [] for name in contenders}
    steps = options.updates * settings.batch
    for _ in range(options.repeats):
        for name, (run, _) in contenders.items():
            begin = time.perf_counter()
            states[name] = jax.block_until_ready(run(states[name]))
            rates[name].append(steps / (time.perf_counter() - begin))
    ratios = [a / b for a, b in zip(*rates.values(), strict=True)]
    result = {
        "rates": rates,
        "ratio": {"median": statistics.median(ratios), "least": min(ratios), "most": max(ratios)},
        "compiled_s": compiled,
        "environment_s": made,
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        "machine": platform.processor() or platform.machine(),
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
    }
    if options.json:
        print(json.dumps(result))
        return
    for name, values in rates.items():
        print(
            f"{name:<20} {statistics.median(values) / 1e3:8.1f} k steps/s  ({min(values) / 1e3:.1f} to "
            f"{max(values) / 1e3:.1f}); first call {compiled[name]:.1f} s"
        )
    print(f"ratio                {result['ratio']['median']:8.2f}           ({min(ratios):.2f} to {max(ratios):.2f})")
    print(f"{os.cpu_count()} cores, load {result['load']:.1f}, jax {jax.__version__}, {result['device']}")


if __name__ == "__main__":
    main()
