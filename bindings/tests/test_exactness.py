"""One graph, three runs: in real time, under the simulated clock, and compiled. They give the same numbers."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import parallax as px
from parallax.trees import flat

pytestmark = pytest.mark.usefixtures("x64")


def variant(name, **changes):
    """A graph that comes with Parallax, with connections changed: `from->to` or `node` to a table."""
    spec = px.Graph(name).spec
    for key, change in changes.items():
        for connection in spec["connection"]:
            if f"{connection['from']}_{connection['to']}" == key:
                connection.update(change)
        for node in spec["node"]:
            if node["name"] == key:
                node.update(change)
    return spec


# Blocking and not, windows, skip, jitter buffers, both schedulings; the plant damped, so that trajectories contract.
DAMPED = {"parameters": {"damping": 2e-3}}
GRAPHS = {
    "as it is": variant("pendulum-simulated", world=DAMPED),
    "nothing blocks": variant(
        "pendulum-simulated", world=DAMPED, encoder_agent={"blocking": False}, agent_motor={"blocking": False}
    ),
    "everything blocks": variant("pendulum-simulated", world=DAMPED, world_encoder={"blocking": True}),
    "windows": variant(
        "pendulum-simulated",
        world=DAMPED,
        world_encoder={"window": 3},
        encoder_agent={"window": 5},
        motor_world={"window": 2},
    ),
    "skip and slow motors": variant(
        "pendulum-simulated",
        world=DAMPED,
        encoder_agent={"skip": True, "blocking": False},
        motor={"rate": 37.0, "scheduling": "frequency"},
        agent_motor={"blocking": False, "jitter": "buffer"},
        encoder={"computation": {"distribution": "normal", "mean": 0.012, "std": 0.004}},
    ),
    "four models": variant("quadrotor-simulated"),
}


def rerun(graph, recording, path):
    """The compiled rollout along a recording with the recorded noise, and what the recorded models went through."""
    went = px.trajectories(path)
    compiled = graph.compile(graph.episodes(path), keep=graph.nodes)
    state = compiled.init(
        jax.random.key(0), {name: graph.model(name).params(went[name].params) for name in graph.nodes}
    )
    noise = {name: jnp.asarray(node.noise) for name, node in went.items() if node.noise.shape[1]}

    def roll(state, noise, tables):
        return compiled.rollout(state, record=graph.nodes, noise=noise, tables=tables)

    _, kept = jax.jit(roll)(state, noise, compiled.tables)
    return went, compiled, kept


def steps_of(kept):
    """The steps of one node in the order of their numbers, from its slots."""
    seq = np.concatenate([np.where(slot["run"], slot["seq"], -1) for slot in kept]).astype(int)
    order = np.argsort(seq, kind="stable")[np.sum(seq < 0) :]

    def picked(name):
        return jax.tree.map(
            lambda *leaves: np.concatenate([np.asarray(leaf) for leaf in leaves])[order], *(s[name] for s in kept)
        )

    return seq[order], picked("output"), picked("state")


@pytest.mark.parametrize("name", GRAPHS)
def test_whole_rollouts_agree(name, tmp_path):
    graph = px.Graph(GRAPHS[name])
    recording = graph.simulate(tmp_path / "run.mcap", 4.0, seed=3)
    went, _, kept = rerun(graph, recording, tmp_path / "run.mcap")
    compared = 0
    for node in graph.nodes:
        assert went[node].differing == 0
        seq, output, _ = steps_of(kept[node])
        leaves = recording[node].leaves
        ours = np.stack(flat(leaves, output, node), axis=-1)
        theirs = recording[node].payload[seq]
        assert len(seq) >= 0.95 * len(recording[node].seq)
        difference = np.abs(ours - theirs)
        if "angle" in leaves:  # readings of an encoder wrap
            place = leaves.index("angle")
            difference[:, place] = np.abs((difference[:, place] + np.pi) % (2 * np.pi) - np.pi)
        assert np.max(difference / (1 + np.abs(theirs))) < 1e-9, node
        compared += len(seq)
    assert compared > 500


def one_step(graph, path, recording):
    """Every recorded step of every model by itself: recorded inputs, state and noise in, output and next state out."""
    went = px.trajectories(path)
    worst = 0.0
    for name in graph.nodes:
        model, track = graph.model(name), recording[name]
        steps = went[name].outputs.shape[0]
        columns = [*np.broadcast_to(went[name].params, (steps, len(went[name].params))).T, *went[name].states[:-1].T]
        columns += [track.step_seq[:steps].astype(float), track.due[:steps], track.start[:steps], *went[name].noise.T]
        for port in graph.ports(name):
            consumed, sender = track.inputs[port.name], recording[graph.nodes[port.sender]]
            for index in range(port.window):
                seq = consumed.seq[:steps, index]
                payload = np.where(seq[:, None] < 0, sender.initial, sender.payload[np.maximum(seq, 0)])
                columns += [
                    seq.astype(float),
                    consumed.sent[:steps, index],
                    consumed.received[:steps, index],
                    *payload.T,
                ]
        ours = np.stack(jax.jit(model.program)(*map(jnp.asarray, columns)), axis=-1)
        theirs = np.concatenate([went[name].states[1:], went[name].outputs], axis=1)
        worst = max(worst, np.max(np.abs(ours - theirs) / (1 + np.abs(theirs))))
    return worst


@pytest.mark.parametrize("name", GRAPHS)
def test_every_step_agrees(name, tmp_path):
    graph = px.Graph(GRAPHS[name])
    recording = graph.simulate(tmp_path / "run.mcap", 4.0, seed=4)
    assert one_step(graph, tmp_path / "run.mcap", recording) < 1e-12


@pytest.mark.parametrize("name", ["as it is", "skip and slow motors"])
def test_real_time_replay_and_compiled_agree(name, tmp_path, parallax_cli):
    graph = px.Graph(GRAPHS[name])
    (tmp_path / "graph.json").write_text(graph.json(), encoding="utf-8")
    path = tmp_path / "wall.mcap"
    toml = tmp_path / "graph.toml"
    toml.write_text(graph.toml(), encoding="utf-8")
    parallax_cli("run", toml, "--duration", "2", "--out", path)
    assert "exact" in parallax_cli("replay", path)  # bit for bit
    recording = px.load(path)
    assert recording.clock["clock"] == "wall"
    assert one_step(graph, path, recording) < 1e-12
    _, _, kept = rerun(graph, recording, path)
    for node in graph.nodes:
        seq, output, _ = steps_of(kept[node])
        ours = np.stack(flat(recording[node].leaves, output, node), axis=-1)
        difference = np.abs(ours - recording[node].payload[seq])
        assert len(seq) >= 60
        assert np.max(np.minimum(difference, np.abs(2 * np.pi - difference))) < 1e-9, node


def test_the_native_batch_agrees():
    graph = px.Graph(GRAPHS["as it is"])
    compiled = graph.compile(graph.generate(2.0, 3, seed=5), pinned=["agent"], keep=["encoder", "world"])
    random = np.random.default_rng(0)
    count = 40
    inertia = 1.6e-4 * (1 + 0.2 * random.random(count))
    actions = random.uniform(-2, 2, (count, compiled.steps, 1))
    episodes = np.arange(count) % 3
    native = compiled.rollout_native(
        episodes, params={"world": {"pendulum": {"inertia": inertia}}}, pinned={"agent": {"voltage": actions[..., 0]}}
    )

    def roll(episode, inertia, actions):
        state = compiled.init(jax.random.key(0), episode=episode)
        state.params["world"]["pendulum"]["inertia"] = inertia
        return compiled.rollout(state, pinned={"agent": {"voltage": actions}})[0].state["world"]

    ours = jax.jit(jax.vmap(roll))(jnp.asarray(episodes), jnp.asarray(inertia), jnp.asarray(actions[..., 0]))
    for leaf in ("angle", "speed"):
        np.testing.assert_allclose(native.states["world"][leaf], ours[leaf], rtol=1e-9, atol=1e-9)
