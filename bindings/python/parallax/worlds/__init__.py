"""Other simulators as nodes of a graph: worlds that stand in for a machine, in real time and under the simulated
clock; those in JAX compile with their graph. Each needs a package of its own, an extra of this one."""

from .brax import BraxWorld
from .drake import DrakeWorld
from .equations import write_mjcf_system
from .mjx import MjxWorld
from .mujoco import MujocoWorld

__all__ = ["BraxWorld", "DrakeWorld", "MjxWorld", "MujocoWorld", "write_mjcf_system"]
