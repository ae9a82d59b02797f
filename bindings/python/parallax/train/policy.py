"""A trained policy: a perceptron with what it observes, its normalisation and its history; its file, and its node."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ..nodes import Step
from ..trees import nested
from ..types import Array, Floats, Tree
from . import network
from .interface import Interface, Memory
from .missing import package

__all__ = ["Policy", "PolicyNode"]

FORMAT = "parallax-policy-1"


@dataclass(frozen=True)
class Policy:
    """What to do about an observation, without noise.

    The file that `save` writes is what the node `kind = "pendulum/policy"` (`policy::kind` in Rust) loads.
    """

    interface: Interface
    """What it sees and sends."""
    weights: tuple[NDArray[np.floating[Any]], ...]
    """Of each layer, `[outputs, inputs]`."""
    biases: tuple[NDArray[np.floating[Any]], ...]
    """Of each layer, `[outputs]`."""
    activation: str
    """Between layers."""
    squash: bool
    """Whether a hyperbolic tangent stands after the last."""
    mean: Floats
    """Of the inputs, `[Interface.size]`."""
    std: Floats
    """Of the inputs, `[Interface.size]`."""
    clip: float
    """Normalised inputs are held within ± this."""

    @classmethod
    def trained(
        cls,
        interface: Interface,
        actor: Sequence[dict[str, Array]],
        activation: str,
        squash: bool,
        mean: Array,
        std: Array,
        clip: float,
    ) -> Policy:
        """From a network's layers, whose weights are `[inputs, outputs]`."""
        return cls(
            interface,
            tuple(np.asarray(layer["weight"], np.float32).T.copy() for layer in actor),
            tuple(np.asarray(layer["bias"], np.float32) for layer in actor),
            activation,
            squash,
            np.asarray(mean, np.float64),
            np.asarray(std, np.float64),
            clip,
        )

    def action(self, inputs: Array) -> Array:
        """The action `[action]`, in the leaves' units, for what enters the network, `[Interface.size]`."""
        x = jnp.clip((inputs - jnp.asarray(self.mean, float)) / jnp.asarray(self.std, float), -self.clip, self.clip)
        layers = [
            {"weight": jnp.asarray(weight, float).T, "bias": jnp.asarray(bias, float)}
            for weight, bias in zip(self.weights, self.biases, strict=True)
        ]
        x = network.evaluate(layers, x, self.activation)
        return self.interface.scaled(jnp.tanh(x) if self.squash else x)

    def start(self, message: Tree) -> Memory:
        """What it remembers before its first step, which sees `message`."""
        return self.interface.start(self.interface.observe(message))

    def step(self, memory: Memory, message: Tree) -> tuple[Memory, Array]:
        """What it remembers next, and its action `[action]`, for the newest message."""
        observation = self.interface.observe(message)
        action = self.action(self.interface.inputs(observation, memory))
        return self.interface.remember(memory, observation, action), action

    def node(self) -> PolicyNode:
        """A node for a compiled graph, or of the kind `python` in real time."""
        return PolicyNode(self)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes a safetensors file; one that stands there is replaced when the new one is whole."""
        numpy = package("safetensors.numpy")
        interface = self.interface
        tensors = {f"layers.{place}.weight": weight for place, weight in enumerate(self.weights)}
        tensors |= {f"layers.{place}.bias": bias for place, bias in enumerate(self.biases)}
        low, high = np.asarray(interface.low), np.asarray(interface.high)
        metadata: dict[str, str] = {
            "format": FORMAT,
            "activation": self.activation,
            "output_activation": "tanh" if self.squash else "none",
            "observations": json.dumps(list(interface.observations)),
            "actions": json.dumps(list(interface.actions)),
            "past_observations": str(interface.past_observations),
            "past_actions": str(interface.past_actions),
            "observation_mean": json.dumps(self.mean.tolist()),
            "observation_std": json.dumps(self.std.tolist()),
            "observation_clip": repr(self.clip),
            "action_scale": json.dumps((0.5 * (high - low)).tolist()),
            "action_offset": json.dumps((0.5 * (high + low)).tolist()),
            "action_low": json.dumps(low.tolist()),
            "action_high": json.dumps(high.tolist()),
        }
        place = Path(path)
        place.parent.mkdir(parents=True, exist_ok=True)
        partial = place.with_name(place.name + ".part")
        numpy.save_file(tensors, partial, metadata=metadata)
        partial.replace(place)
        return place

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Policy:
        """Reads a file that `save` wrote."""
        safetensors = package("safetensors")
        with safetensors.safe_open(os.fspath(path), framework="numpy") as file:
            metadata: dict[str, Any] = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise ValueError(f"{path} is no policy: its metadata's `format` is {metadata.get('format')!r}")
            missing = [key for key in ("observations", "actions", "action_low", "action_high") if key not in metadata]
            if missing:
                raise ValueError(f"{path}: its metadata lack {', '.join(missing)}; `Policy.save` writes them")
            count = sum(name.endswith(".weight") for name in file.keys())  # noqa: SIM118 (no dictionary)
            weights = tuple(file.get_tensor(f"layers.{place}.weight") for place in range(count))
            biases = tuple(file.get_tensor(f"layers.{place}.bias") for place in range(count))
        interface = Interface(
            tuple(json.loads(metadata["observations"])),
            tuple(json.loads(metadata["actions"])),
            tuple(json.loads(metadata["action_low"])),
            tuple(json.loads(metadata["action_high"])),
            int(metadata.get("past_observations", 0)),
            int(metadata.get("past_actions", 0)),
        )
        return cls(
            interface,
            weights,
            biases,
            metadata["activation"],
            metadata.get("output_activation") == "tanh",
            np.asarray(json.loads(metadata.get("observation_mean", "0")), np.float64) + np.zeros(interface.size),
            np.asarray(json.loads(metadata.get("observation_std", "1")), np.float64) * np.ones(interface.size),
            float(metadata.get("observation_clip", "inf")),
        )


class PolicyNode:
    """A policy as a node that is written in JAX; it observes its only input."""

    def __init__(self, policy: Policy | str | os.PathLike[str]) -> None:
        """`policy` may be a file, so that a graph can name it: `arguments = { policy = "policy.safetensors" }`."""
        self.policy = policy if isinstance(policy, Policy) else Policy.load(policy)

    def init_params(self, key: Array) -> Tree:
        """None: the policy is trained."""
        return {}

    def init_state(self, key: Array, params: Tree) -> Tree:
        """Nothing is remembered yet."""
        interface = self.policy.interface
        nothing = interface.start(jnp.zeros(len(interface.observations), float))
        return {"observations": nothing.observations, "actions": nothing.actions, "steps": jnp.asarray(0, jnp.int32)}

    def init_output(self, key: Array, params: Tree, state: Tree) -> Tree:
        """Nothing is done yet."""
        actions = self.policy.interface.actions
        return nested(list(actions), [jnp.asarray(0.0, float) for _ in actions])

    def step(self, params: Tree, state: Tree, step: Step) -> tuple[Tree, Tree]:
        """The policy's action for the newest message."""
        (window,) = step.inputs.values()
        message = window.latest.message
        interface = self.policy.interface
        first = interface.start(interface.observe(message))
        begins = state["steps"] == 0
        memory = Memory(
            jnp.where(begins, first.observations, state["observations"]),
            jnp.where(begins, first.actions, state["actions"]),
        )
        memory, action = self.policy.step(memory, message)
        after = {"observations": memory.observations, "actions": memory.actions, "steps": state["steps"] + 1}
        actions = list(interface.actions)
        return after, nested(actions, [action[place] for place in range(len(actions))])
