"""Two nodes in Python for the simulated pendulum: one in JAX, one in plain Python.

parallax run examples/python/graph.toml --duration 5 --out out/python.mcap
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import parallax as px


class Brake(px.Node):
    """Brakes: a voltage against the speed. Its step is compiled before the run starts."""

    def __init__(self, gain: float = 0.05) -> None:
        self.gain = gain

    def init_params(self, key: jax.Array) -> dict[str, jax.Array]:
        """The gain."""
        return {"gain": jnp.asarray(self.gain)}

    def init_output(
        self, key: jax.Array, params: dict[str, jax.Array], state: None
    ) -> dict[str, jax.Array]:
        """No voltage."""
        return {"voltage": jnp.asarray(0.0)}

    def step(
        self, params: dict[str, jax.Array], state: None, step: px.Step
    ) -> tuple[None, dict[str, jax.Array]]:
        """The voltage for the newest estimate."""
        return state, {
            "voltage": -params["gain"] * step["estimator"].latest.message["speed"]
        }


class Swing:
    """Pushes to and fro, harder the longer it runs."""

    def __init__(self, rate: float = 0.1) -> None:
        self.rate = rate
        self.voltage = 0.0

    def step(self, step: px.Step) -> dict[str, float]:
        """The next voltage: against the way that it moves now."""
        speed = step["estimator"].latest.message["speed"]
        self.voltage = min(self.voltage + self.rate / 100, 2.0)
        return {"voltage": self.voltage if speed >= 0.0 else -self.voltage}

    def stop(self, why: str) -> None:
        """Nothing is left on."""
        self.voltage = 0.0
