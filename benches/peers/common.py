"""What the scripts of all peers share: the work, how it is timed, and how it is reported.

Each script prints one JSON object a line on its standard output; `cargo bench --bench throughput` collects them. A
script also runs alone: `VENV/bin/python benches/peers/NAME.py --envs 1,128 --dtype f32`.

Import this before jax: it pins the process to one core and tells XLA to use one thread, unless --device is gpu.
"""

import argparse
import json
import os
import sys
import time

RATE = 50  # of the supervisor, Hz
STEP = 0.01  # of the Runge-Kutta method, s: two a supervisor step
SECONDS = 20  # of an episode
STEPS = RATE * SECONDS
EPISODES = 20  # different schedules, spread over the environments
# Gaussian delays of the graph, s: mean and standard deviation.
SENSOR, AGENT, MOTOR = (0.002, 0.0004), (0.002, 0.0005), (0.001, 0.0002)
WIRE = (0.001, 0.0003)


def options(envs="1,128,1024", dtypes="f32"):
    """The command line, and the machine set up as it says."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--envs", default=envs, type=lambda text: [int(n) for n in text.split(",")])
    parser.add_argument("--dtype", default=dtypes, type=lambda text: text.split(","))
    parser.add_argument("--repeats", default=7, type=int)
    parser.add_argument("--seconds", default=0.3, type=float, help="least time of one measurement")
    parser.add_argument("--core", default=0, type=int)
    parser.add_argument("--device", default="cpu", choices=["cpu", "gpu"])
    chosen = parser.parse_args()
    if chosen.device == "cpu":
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, {chosen.core})
        os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
        os.environ["JAX_PLATFORMS"] = "cpu"
        for variable in ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"]:
            os.environ[variable] = "1"
    return chosen


def number(dtype):
    """The numpy type of "f32" or "f64"."""
    import numpy as np

    return {"f32": np.float32, "f64": np.float64}[dtype]


def measure(run, chosen):
    """Seconds of one call of `run`, once for each repetition. The first calls, which may compile, are not timed."""
    run()
    start = time.perf_counter()
    run()
    once = time.perf_counter() - start
    calls = max(1, int(chosen.seconds / max(once, 1e-9)))
    seconds = []
    for _ in range(chosen.repeats):
        start = time.perf_counter()
        for _ in range(calls):
            run()
        seconds.append((time.perf_counter() - start) / calls)
    return seconds


def report(**line):
    """Writes one line of the report."""
    print(json.dumps(line), flush=True)


def throughput(peer, case, dtype, envs, steps, seconds, **more):
    """Reports `seconds` that `envs` environments took for `steps` supervisor steps each."""
    rates = sorted(envs * steps / s for s in seconds)
    report(peer=peer, case=case, dtype=dtype, envs=envs, steps_per_second=rates, **more)


def value(peer, name, amount, unit, **more):
    """Reports something that is no throughput."""
    report(peer=peer, value=name, amount=amount, unit=unit, **more)


def note(text):
    """Tells the person at the terminal something."""
    print(text, file=sys.stderr, flush=True)
