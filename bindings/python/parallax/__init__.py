"""Robots as graphs of nodes, from Python.

`load` reads a recording as numpy arrays; `System` turns a `system.toml`, and `models` the ready-made models, into JAX
functions; `Graph` holds a graph, generates schedules for it and compiles it to pure functions that work under `jit`,
`vmap`, `grad` and `scan`. `set_parameter` sets a parameter of a node that runs.

Times are seconds since the run's start, in SI units throughout, unless a name ends in `_ns`.
"""

# Before anything that takes long to import: it has a Ctrl-C come again that falls into a callback.
from . import _interrupts as _interrupts
from ._native import ParallaxError, __version__
from .cache import use_compilation_cache
from .commands import CommandError
from .compiled import CompiledGraph
from .delay import Constant, Mixture, Normal, Trainable
from .delays import TrainableDelay
from .flow import DataFlow
from .graph import FAST_AS_POSSIBLE, REAL_TIME, SIMULATED, WALL_CLOCK, Episodes, Graph
from .identify import Estimate, Evolution, Identified, evolve, identify
from .live import NodeReading, node_reading, reset_state, set_parameter, set_parameters
from .member import Connection, Node, PlainNode, RustNode
from .model import Model, models
from .native_rollout import NativeRollout
from .nodes import Message, ModelNode, Port, Step, Stepped, Window
from .program import Program
from .recording import NodeTrack, PortTrack, Recording, Trajectory, load, trajectories
from .running import RunState
from .state import GraphState, Observation
from .system import Parameter, System
from .tables import Tables
from .written import Joint, Reading, write_system
from .xla import run_small_loops_whole

__all__ = [
    "FAST_AS_POSSIBLE",
    "REAL_TIME",
    "SIMULATED",
    "WALL_CLOCK",
    "CommandError",
    "CompiledGraph",
    "Connection",
    "Constant",
    "DataFlow",
    "Episodes",
    "Estimate",
    "Evolution",
    "Graph",
    "GraphState",
    "Identified",
    "Joint",
    "Message",
    "Mixture",
    "Model",
    "ModelNode",
    "NativeRollout",
    "Node",
    "NodeReading",
    "NodeTrack",
    "Normal",
    "Observation",
    "ParallaxError",
    "Parameter",
    "PlainNode",
    "Port",
    "PortTrack",
    "Program",
    "Reading",
    "Recording",
    "RunState",
    "RustNode",
    "Step",
    "Stepped",
    "System",
    "Tables",
    "Trainable",
    "TrainableDelay",
    "Trajectory",
    "Window",
    "__version__",
    "evolve",
    "identify",
    "load",
    "models",
    "node_reading",
    "reset_state",
    "set_parameter",
    "set_parameters",
    "trajectories",
    "use_compilation_cache",
    "write_system",
]

run_small_loops_whole()
