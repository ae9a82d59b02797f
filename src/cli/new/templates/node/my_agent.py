"""A node: it swings a pendulum up and balances it. The graph beside this file names it: class = "my_agent:MyAgent".

What it sees is what its senders send, and what it returns is what its receiver takes. For a node in JAX, which also compiles
with its graph, see docs/python.md.
"""

from __future__ import annotations

import math

import parallax as px


class MyAgent:
    """What it remembers from step to step are its attributes; it is made anew for every run, in a process of its own."""

    def __init__(self, limit: float = 4.0) -> None:
        """`limit` is the largest voltage that it asks for, V: `arguments` in the graph."""
        self.limit = limit

    def step(self, step: px.Step) -> dict[str, float]:
        """One step: the newest estimate (angle from upright, rad; speed, rad/s) to a voltage, V."""
        estimate = step["estimator"].latest.message
        angle, speed = float(estimate["angle"]), float(estimate["speed"])
        if abs(angle) < 0.4 and abs(speed) < 5.0:
            voltage = -(16.0 * angle + 1.4 * speed)
        else:
            # The energy, 1 when it rests upright; what is missing is pumped in, what is too much taken out.
            energy = 0.00387 * speed * speed + math.cos(angle)
            push = min(max(6.0 * (1.0 - energy), -3.0), 3.0)
            voltage = 0.1 * push if abs(speed) < 0.05 else push * math.tanh(speed / 2.0)
        return {"voltage": min(max(voltage, -self.limit), self.limit)}

    def stop(self, why: str) -> None:
        """The last thing it does, however its run ends: a driver stops its hardware here."""
