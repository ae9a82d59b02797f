"""Computation delays that follow from a node's own output: compiled, they are what the executor makes of them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import parallax as px
from parallax.trees import flat

DURATION = 1.2
SEED = 3
AT_RUN_TIME = "at run time"


def by_output(leaf, offset, scale, low, high):
    return {"distribution": "output", "leaf": leaf, "offset": offset, "scale": scale, "min": low, "max": high}


def pendulum(window=1, skip=False, blocking=False):
    """The faster it turns, the longer the encoder takes, and the motor takes longer at high voltage: what arrives when
    decides what the motor does, and so what arrives when."""
    spec = px.Graph("pendulum-simulated").spec
    nodes = {node["name"]: node for node in spec["node"]}
    nodes["world"]["parameters"] = {"damping": 2e-3}
    nodes["agent"]["parameters"] = {"excitation": 0.0}  # its phases are drawn from the seed
    # Half of the delays are at a bound, and the message then arrives exactly when the agent starts.
    rule = (0.009, 2e-2, 0.0, 0.009) if skip else (0.004, 2e-2, 0.004, 0.0099)
    nodes["encoder"]["computation"] = by_output("speed", *rule) | {"expected": 0.004}
    nodes["motor"]["computation"] = by_output("voltage", 0.01, 0.02, 0.001, 0.0189)
    for edge in spec["connection"]:
        edge["blocking"] = blocking and edge["from"] == "encoder"
        if edge["from"] in ("encoder", "motor"):
            edge.update(delay={"distribution": "constant", "seconds": 0.001}, window=window)
        if edge["from"] == "encoder":
            edge["skip"] = skip
    return px.Graph(spec)


def outputs(compiled, went, recording):
    """Every node's outputs along the first episode with the recorded noise: `(seq, [step, leaf])`."""
    noise = {name: jnp.asarray(node.noise) for name, node in went.items() if node.noise.shape[1]}
    names = list(went)

    def roll(state, tables):
        return compiled.rollout(state, record=names, noise=noise, tables=tables)[1]

    kept = jax.jit(roll)(compiled.init(jax.random.key(0)), compiled.tables)
    result = {}
    for name in names:
        seq = np.concatenate([np.where(slot["run"], slot["seq"], -1) for slot in kept[name]]).astype(int)
        slots = [np.stack(flat(recording[name].leaves, slot["output"], name), axis=-1) for slot in kept[name]]
        order = np.argsort(seq, kind="stable")[np.sum(seq < 0) :]
        result[name] = seq[order], np.concatenate(slots)[order]
    return result


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(("window", "skip"), [(1, False), (3, True), (2, False)])
def test_outputs_decide_as_in_the_executor(window, skip, tmp_path):
    graph = pendulum(window, skip)
    path = tmp_path / "run.mcap"
    recording = graph.simulate(path, DURATION, seed=SEED)
    episodes = graph.episodes(path)
    went = px.trajectories(path)
    compiled = graph.compile(episodes, keep=graph.nodes, output_delays=AT_RUN_TIME)
    for name, (seq, ours) in outputs(compiled, went, recording).items():
        assert len(seq) >= 0.95 * len(recording[name].seq)
        np.testing.assert_allclose(ours, recording[name].payload[seq], rtol=1e-12, atol=1e-12, err_msg=name)
    # Its own noise follows from the seed; on plain numbers it repeats the run.
    native = compiled.rollout_native([0], seeds=[SEED], keep=graph.nodes, precision="double")
    for name, tree in native.outputs.items():
        ours = np.stack(flat(recording[name].leaves, tree, name), axis=-1)[0]
        ran = ~np.isnan(ours[:, 0])
        assert ran.sum() >= 0.95 * len(recording[name].seq)
        np.testing.assert_array_equal(ours[ran], recording[name].payload[: len(ours)][ran], err_msg=name)


class Reporter:
    """Says what it saw."""

    def __init__(self, window):
        self.window = window

    def init_params(self, key):
        return {}

    def init_state(self, key, params):
        return {}

    def init_output(self, key, params, state):
        none = jnp.zeros(self.window)
        return {"voltage": jnp.asarray(0.0), "seq": none, "sent": none, "received": none}

    def step(self, params, state, step):
        def seen(name):
            return jnp.stack([jnp.asarray(getattr(message, name), float) for message in step["estimator"]])

        return state, {"voltage": jnp.asarray(0.0)} | {name: seen(name) for name in ("seq", "sent", "received")}


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(("window", "skip"), [(1, False), (2, False), (3, True)])
def test_a_step_sees_the_messages_and_times_that_were_recorded(window, skip, tmp_path):
    graph = pendulum(window, skip)
    path = tmp_path / "run.mcap"
    recording = graph.simulate(path, DURATION, seed=SEED)
    compiled = graph.compile(
        graph.episodes(path), {"agent": Reporter(window)}, pinned=["encoder"], output_delays=AT_RUN_TIME
    )
    encoder = recording["encoder"]
    pinned = {"encoder": {leaf: jnp.asarray(encoder.payload[:, i]) for i, leaf in enumerate(encoder.leaves)}}
    _, kept = jax.jit(lambda state, tables: compiled.rollout(state, record=["agent"], pinned=pinned, tables=tables))(
        compiled.init(jax.random.key(0)), compiled.tables
    )
    seen = kept["agent"][0]["output"]
    consumed = recording["agent"].inputs["estimator"]
    np.testing.assert_array_equal(seen["seq"], consumed.seq)
    np.testing.assert_allclose(seen["sent"], consumed.sent, rtol=0, atol=1e-12)
    np.testing.assert_allclose(seen["received"], consumed.received, rtol=0, atol=1e-12)
    # How old the newest message is differs from step to step.
    assert np.ptp(recording["agent"].start[1:] - encoder.start[consumed.seq[1:, -1]]) > 0.005


def test_schedules_that_know_no_outputs_give_others():
    graph = pendulum(2)
    episodes = graph.generate(DURATION, 2, seed=5)

    def voltages(how):
        compiled = graph.compile(episodes, output_delays=how)
        return compiled.rollout_native([0, 1], keep=["agent"]).outputs["agent"]["voltage"]

    assert not np.array_equal(voltages("as scheduled"), voltages(AT_RUN_TIME))


def test_gradients_pass_and_environments_differ():
    """Every environment has its own windows; derivatives are those along them."""
    graph = pendulum(2)
    compiled = graph.compile(graph.generate(0.5, 1, seed=5), output_delays=AT_RUN_TIME)

    def last(inertia):
        state = compiled.init(jax.random.key(0))
        state.params["world"]["pendulum"]["inertia"] = inertia
        return compiled.rollout(state)[0].state["world"]["angle"]

    inertias = jnp.asarray([1.6e-4, 1.7e-4, 2.4e-4])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(last)))(inertias)
    assert len(set(np.asarray(values).tolist())) == 3
    assert np.all(np.isfinite(slopes))
    assert np.all(np.asarray(slopes) != 0)


def test_what_cannot_be_decided_at_run_time_is_named():
    graph = pendulum(blocking=True)
    episodes = graph.generate(DURATION, 1)
    graph.compile(episodes)
    with pytest.raises(px.ParallaxError, match=r"node `encoder` follows from its output .* waits for its messages"):
        graph.compile(episodes, output_delays=AT_RUN_TIME)
