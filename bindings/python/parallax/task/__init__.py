"""Whole tasks, from a recording to a policy that runs: `python -m parallax.task pendulum`, or `parallax task pendulum`.

A machine whose constants and delays nobody here knows runs in real time as processes. It is recorded, identified, its
delays are fitted, policies are trained on what was found, and they run on the machine; one page tells what came out.
"""

from .pendulum import pendulum
from .quadrotor import quadrotor
from .work import Options, Result

__all__ = ["Options", "Result", "pendulum", "quadrotor"]
