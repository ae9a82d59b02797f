"""How XLA compiles loops on a CPU."""

from __future__ import annotations

import os

__all__ = ["run_small_loops_whole"]

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
