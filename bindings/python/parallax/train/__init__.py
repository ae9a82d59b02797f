"""Training of policies on graphs with their delays.

`GraphEnvironment` makes an environment of a graph and a task, `train` trains policies on it by proximal policy
optimisation, all of it compiled, and `Policy` is what comes out: a file that the policy's node in Rust loads. Other
libraries drive the same environment: its functions are those of gymnax 1.0, and `parallax.train.gym` has it for
gymnasium. Training needs the package's extra `train`, gymnasium the extra `gym`.
"""

from .checkpoint import CheckpointError
from .curves import plot_curves, read_log
from .environment import Box, EnvironmentParams, EnvironmentState, GraphEnvironment
from .interface import Interface, Memory
from .policy import Policy, PolicyNode
from .ppo import PENDULUM, PPO, QUADROTOR, Learner, TrainState, advantages
from .randomisation import Joint, LogUniform, Normal, Randomisation, Uniform
from .run import Training, train
from .schedules import varied_episodes
from .task import Task, with_state
from .tasks import PendulumSwingUp, QuadrotorCircle

__all__ = [
    "PENDULUM",
    "PPO",
    "QUADROTOR",
    "Box",
    "CheckpointError",
    "EnvironmentParams",
    "EnvironmentState",
    "GraphEnvironment",
    "Interface",
    "Joint",
    "Learner",
    "LogUniform",
    "Memory",
    "Normal",
    "PendulumSwingUp",
    "Policy",
    "PolicyNode",
    "QuadrotorCircle",
    "Randomisation",
    "Task",
    "TrainState",
    "Training",
    "Uniform",
    "advantages",
    "plot_curves",
    "read_log",
    "train",
    "varied_episodes",
    "with_state",
]
