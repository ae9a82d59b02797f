"""Robots as graphs of nodes, from Python.

`load` reads a recording as numpy arrays; `System` turns a `system.toml`, and `models` the ready-made models, into JAX
functions; `Graph` holds a graph, generates schedules for it and compiles it to pure functions that work under `jit`,
`vmap`, `grad` and `scan`. `set_parameter` sets a parameter of a node that runs.

Times are seconds since the run's start, in SI units throughout, unless a name ends in `_ns`.
"""

from ._native import ParallaxError, __version__
from .cache import use_compilation_cache
from .compiled import CompiledGraph
from .delays import TrainableDelay
from .graph import Episodes, Graph
from .live import NodeReading, node_reading, reset_state, set_parameter, set_parameters
from .model import Model, models
from .native_rollout import NativeRollout
from .nodes import Message, ModelNode, Node, Port, Step, Window
from .program import Program
from .recording import NodeTrack, PortTrack, Recording, Trajectory, load, trajectories
from .state import GraphState, Observation
from .system import System
from .tables import Tables
from .xla import run_small_loops_whole

__all__ = [
    "CompiledGraph",
    "Episodes",
    "Graph",
    "GraphState",
    "Message",
    "Model",
    "ModelNode",
    "NativeRollout",
    "Node",
    "NodeReading",
    "NodeTrack",
    "Observation",
    "ParallaxError",
    "Port",
    "PortTrack",
    "Program",
    "Recording",
    "Step",
    "System",
    "Tables",
    "TrainableDelay",
    "Trajectory",
    "Window",
    "__version__",
    "load",
    "models",
    "node_reading",
    "reset_state",
    "set_parameter",
    "set_parameters",
    "trajectories",
    "use_compilation_cache",
]

run_small_loops_whole()
