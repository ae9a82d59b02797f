"""Other simulators as nodes of a graph: worlds that stand in for a machine, in real time and under the simulated
clock."""

from .mjx import MjxWorld
from .mujoco import MujocoWorld

__all__ = ["MjxWorld", "MujocoWorld"]
