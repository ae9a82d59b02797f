"""Policies: the file, the node in Rust that loads it, and the node in JAX, do the same as what was trained."""

from __future__ import annotations

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import parallax as px
from parallax import train as pt

pytestmark = pytest.mark.usefixtures("compiled_once")


def policy(past_observations=3, past_actions=2, observations=("cos(angle)", "sin(angle)", "speed"), squash=True):
    """One with 64×64 random weights, and statistics of its own."""
    interface = pt.Interface.of(observations, {"voltage": (-3.0, 4.0)}, past_observations, past_actions)
    random = np.random.default_rng(4)
    widths = [interface.size, 64, 64, 1]
    actor = [
        {"weight": random.normal(0, 0.8 / np.sqrt(i), (i, o)), "bias": random.normal(0, 0.1, o)}
        for i, o in pairwise(widths)
    ]
    mean, std = random.normal(0, 0.3, interface.size), random.uniform(0.5, 3.0, interface.size)
    return pt.Policy.trained(interface, actor, "tanh", squash, mean, std, 10.0)


def graph_with(path, kind="pendulum/policy"):
    """The simulated pendulum, its agent the policy in a file."""
    spec = px.Graph("pendulum-simulated").spec
    agent = next(node for node in spec["node"] if node["name"] == "agent")
    agent |= {"kind": kind, "parameters": {"file": str(path)}}
    for edge in spec["connection"]:
        if edge["to"] == "agent":
            edge["port"] = "observation"
    return px.Graph(spec)


@pytest.mark.parametrize("squash", [True, False])
def test_the_node_in_rust_does_the_same(tmp_path, x64, squash):
    ours = policy(squash=squash)
    path = ours.save(tmp_path / "policy.safetensors")
    recording = graph_with(path).simulate(tmp_path / "run.mcap", 3.0, seed=2)
    agent, encoder = recording["agent"], recording["encoder"]
    sent = agent.payload[:, agent.leaves.index("voltage")]
    port = agent.inputs["observation"]
    newest = port.seq[:, -1]
    assert np.ptp(sent) > 1.0
    memory, worst = None, 0.0
    for step, seq in enumerate(newest):
        message = dict(zip(encoder.leaves, encoder.payload[seq], strict=True))
        memory = ours.start(message) if memory is None else memory
        memory, action = ours.step(memory, message)
        worst = max(worst, abs(float(action[0]) - sent[step]))
    assert len(newest) > 100
    assert worst < 1e-6, worst


def test_single_precision_is_near(tmp_path):
    ours = policy()
    inputs = np.random.default_rng(1).normal(0, 2, (200, ours.interface.size))
    single = jax.vmap(ours.action)(jnp.asarray(inputs, jnp.float32))
    with jax.enable_x64(True):
        double = jax.vmap(ours.action)(jnp.asarray(inputs, jnp.float64))
    np.testing.assert_allclose(single, double, atol=2e-5)


def test_a_file_is_read_back(tmp_path, x64):
    ours = policy()
    again = pt.Policy.load(ours.save(tmp_path / "policy.safetensors"))
    assert again.interface == ours.interface
    inputs = jnp.asarray(np.random.default_rng(1).normal(0, 2, ours.interface.size))
    np.testing.assert_array_equal(again.action(inputs), ours.action(inputs))
    (tmp_path / "other.safetensors").write_bytes((8).to_bytes(8, "little") + b"{}      ")
    with pytest.raises(ValueError, match="no policy"):
        pt.Policy.load(tmp_path / "other.safetensors")


def test_the_node_in_jax_does_what_the_environment_did(x64):
    # The policy steps the environment from outside; the node is compiled into the graph. Same schedule, same numbers.
    task = pt.PendulumSwingUp(seconds=1.0)
    environment = pt.GraphEnvironment(
        "pendulum-simulated", task, episodes=1, spare=0.1, past_observations=3, past_actions=2
    )
    ours = policy()
    params = environment.default_params
    _, state = environment.reset_env(jax.random.key(0), params)
    voltages, begin = [], state.graph
    step = jax.jit(environment.step_env)
    for _ in range(environment.longest):
        action = ours.action(environment.interface.inputs(state.observation, state.memory))
        voltages.append(float(action[0]))
        # The task's range is ±4 V.
        _, state, *_ = step(jax.random.key(0), state, action / 4.0, params)

    graph = px.Graph("pendulum-simulated")
    episodes = graph.generate(task.seconds + 0.1 + 4 / environment.rate, 1, 0)
    compiled = graph.compile(episodes, {"agent": ours.node()})
    start = compiled.init(begin.key, episode=0, step=begin.step)
    start = task.start(jax.random.split(jax.random.key(0), 4)[3], start)
    _, kept = compiled.rollout(start, environment.longest, record=["agent"])
    np.testing.assert_allclose(kept["agent"][0]["output"]["voltage"], voltages, atol=1e-9)


def test_only_known_names_are_taken():
    with pytest.raises(ValueError, match="the first must be less"):
        pt.Interface.of(("speed",), {"voltage": (1.0, 1.0)})
    with pytest.raises(ValueError, match="at least one"):
        pt.Interface.of((), {"voltage": (0.0, 1.0)})
