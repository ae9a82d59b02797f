"""How XLA compiles for CPUs."""

from __future__ import annotations

import os
import subprocess
import sys

__all__ = ["fuse_nothing_on_cpus", "run_small_loops_whole"]

LOOP_BYTES = 200_000
"""Loops whose steps touch less than this become one function: up to five times faster for few environments."""


def run_small_loops_whole() -> None:
    """Lets XLA compile a rollout's loop as one function where its steps touch little data.

    Its own limit is 1 kB a step, which a graph of several nodes exceeds; each of its steps would then be handed out
    kernel by kernel, at a cost like that of the arithmetic of a hundred environments. XLA reads its flags when JAX
    computes for the first time; flags of this kind that are set already are left as they are.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        option = f"--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold={LOOP_BYTES}"
        # First: XLA reads no further than a word that it does not know.
        os.environ["XLA_FLAGS"] = f"{option} {flags}".strip()


def fuse_nothing_on_cpus() -> None:
    """Lets XLA fuse nothing where JAX computes on a CPU.

    There it fuses the ticks of a graph without delays into functions that compute the same numbers again and again:
    such trainings take up to ten times as long. On accelerators fusing is what makes them fast, so another process is
    asked which it is: XLA reads its flags when JAX computes for the first time. A flag that is set is left alone.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_disable_hlo_passes" in flags:
        return
    asked = [sys.executable, "-c", "import jax; print(jax.default_backend())"]
    told = subprocess.run(asked, capture_output=True, text=True, check=False)
    if told.returncode == 0 and told.stdout.split()[-1:] == ["cpu"]:
        os.environ["XLA_FLAGS"] = f"--xla_disable_hlo_passes=fusion {flags}".strip()
