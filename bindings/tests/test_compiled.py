"""Compiled graphs are pure functions: with Rust and JAX nodes, under jit, vmap and grad, with delays to be found."""

from __future__ import annotations

import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import parallax as px

HIDDEN = "world->encoder"


class Spring(px.Node):
    """An agent written in JAX: a voltage against angle and speed, with a memory of what it last said."""

    def init_params(self, key):
        return {"gains": jnp.asarray([0.3, 0.02])}

    def init_state(self, key, params):
        return {"last": jnp.asarray(0.0)}

    def init_output(self, key, params, state):
        return {"voltage": jnp.asarray(0.0)}

    def step(self, params, state, step):
        seen = step["estimator"].latest.message
        wanted = -params["gains"] @ jnp.stack([jnp.sin(seen["angle"]), seen["speed"]])
        voltage = 0.5 * (state["last"] + wanted)
        return {"last": voltage}, {"voltage": voltage}


@pytest.fixture(scope="module")
def graph():
    return px.Graph("pendulum-simulated")


def angle(state):
    return state.state["world"]["angle"]


def test_a_batch_is_its_environments(graph):
    compiled = graph.compile(graph.generate(2.0, episodes=3, seed=0))

    def roll(key, episode, mass, tables):
        state = compiled.init(key, episode=episode)
        state.params["world"]["pendulum"]["mass"] = mass
        return compiled.rollout(state, record=angle, tables=tables)[1]

    keys, episodes = jax.random.split(jax.random.key(1), 6), jnp.arange(6) % 3
    masses = jnp.linspace(0.04, 0.06, 6)
    together = jax.jit(jax.vmap(roll, (0, 0, 0, None)))(keys, episodes, masses, compiled.tables)
    assert together.shape == (6, compiled.steps)
    assert np.all(np.isfinite(together))
    assert len(np.unique(np.asarray(together[:, -1]))) == 6
    alone = jax.jit(roll)
    for place in (0, 4):
        one = alone(keys[place], episodes[place], masses[place], compiled.tables)
        # Single precision; the first second, before small differences grow.
        np.testing.assert_allclose(one[:50], together[place, :50], rtol=2e-4, atol=2e-4)


def test_stepping_is_rolling_out(graph, x64):
    compiled = graph.compile(graph.generate(1.0, seed=2))
    state = compiled.init(jax.random.key(0))
    final, rolled = jax.jit(lambda state, tables: compiled.rollout(state, record=angle, tables=tables))(
        state, compiled.tables
    )

    step = jax.jit(compiled.step)
    state, seen = jax.jit(compiled.reset)(state)
    angles = []
    for _ in range(compiled.steps - 1):
        angles.append(angle(state))
        state, seen = step(state, None, compiled.tables)
    np.testing.assert_allclose(angles, rolled[:-1], rtol=1e-12, atol=1e-12)
    assert set(seen.inputs) == {"estimator"}
    assert seen.inputs["estimator"]["message"]["angle"].shape == (1,)
    assert int(final.step) == compiled.steps


def test_a_given_output_takes_the_place_of_the_supervisors(graph, x64):
    compiled = graph.compile(graph.generate(1.0, seed=2))
    state = compiled.init(jax.random.key(0))
    voltages = jnp.sin(jnp.arange(compiled.steps) * 0.3)
    _, rolled = compiled.rollout(state, record=angle, pinned={"agent": {"voltage": voltages}})
    state, _ = compiled.reset(state)
    step = jax.jit(compiled.step)
    for voltage in voltages[:-1]:
        state, _ = step(state, {"voltage": voltage}, compiled.tables)
    # The rollout ends with the supervisor's last step, before what would follow it.
    np.testing.assert_allclose(angle(state), rolled[-1], rtol=1e-12)


def test_nodes_in_jax_and_in_rust_mix(graph, x64):
    episodes = graph.generate(3.0, episodes=2, seed=5)
    compiled = graph.compile(episodes, nodes={"agent": Spring()})

    def final_speed(gains, tables):
        state = compiled.init(jax.random.key(0), {"agent": {"gains": gains}})
        return compiled.rollout(state, tables=tables)[0].state["world"]["speed"]

    gains = jnp.asarray([0.3, 0.02])
    slope = jax.jit(jax.grad(final_speed))(gains, compiled.tables)
    for place in range(2):
        h = 1e-6 * jnp.eye(2)[place]
        expected = (final_speed(gains + h, compiled.tables) - final_speed(gains - h, compiled.tables)) / 2e-6
        np.testing.assert_allclose(slope[place], expected, rtol=1e-4, atol=1e-8)
    assert np.any(slope != 0)


def test_state_is_small(graph):
    compiled = graph.compile(graph.generate(10.0, episodes=20, seed=0))
    assert compiled.state_bytes() <= 2048


def delayed(graph, interpolation):
    """The pendulum, its encoder an unknown time behind, without noise."""
    spec = graph.spec
    for node in spec["node"]:
        if node["name"] == "encoder":
            node["parameters"] = {"angle_noise": 0.0, "speed_noise": 0.0}
    graph = px.Graph(spec)
    compiled = graph.compile(
        graph.generate(2.0, seed=7), trainable={HIDDEN: (0.0, 0.03, interpolation)}, keep=["encoder"]
    )
    return graph, compiled


def seen_speeds(compiled, alpha, mass=0.0509):
    state = compiled.init(jax.random.key(0), {"delays": {HIDDEN: alpha}})
    state.params["world"]["pendulum"]["mass"] = mass
    voltages = {"voltage": 2.0 * jnp.sin(jnp.arange(compiled.steps) * 0.2)}
    _, kept = compiled.rollout(
        state, record=lambda state: state.history["encoder"][0]["speed"], pinned={"agent": voltages}
    )
    return kept


@pytest.mark.parametrize("interpolation", ["hold", "linear"])
def test_a_trainable_delay_delays(graph, x64, interpolation):
    _, compiled = delayed(graph, interpolation)
    # 20 ms are one step of the supervisor: what is seen is what was seen a step before. A held message is as old for
    # any delay above 10 ms; at 20 ms exactly rounding would decide.
    early, late = seen_speeds(compiled, 0.0), seen_speeds(compiled, 2 / 3 if interpolation == "linear" else 0.6)
    np.testing.assert_allclose(late[10:], early[9:-1], rtol=1e-9, atol=1e-9)
    between = seen_speeds(compiled, 0.5)
    if interpolation == "linear":
        mean = 0.5 * (seen_speeds(compiled, 1 / 3) + late)
        np.testing.assert_allclose(between[10:], mean[10:], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("interpolation", ["hold", "linear"])
def test_gradients_pass_through_delays_and_parameters(graph, x64, interpolation):
    _, compiled = delayed(graph, interpolation)
    target = seen_speeds(compiled, 0.62, 0.0509)

    def loss(alpha, mass):
        return jnp.mean((seen_speeds(compiled, alpha, mass) - target) ** 2)

    alpha, mass = 0.41, 0.048
    slopes = jax.jit(jax.grad(loss, (0, 1)))(alpha, mass)
    h = 1e-6
    by_alpha = (loss(alpha + h, mass) - loss(alpha - h, mass)) / (2 * h)
    by_mass = (loss(alpha, mass + h) - loss(alpha, mass - h)) / (2 * h)
    np.testing.assert_allclose(slopes[0], by_alpha, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(slopes[1], by_mass, rtol=1e-5)
    assert slopes[1] != 0
    if interpolation == "linear":
        assert slopes[0] != 0


def test_a_delay_is_found_by_descent(graph, x64):
    _, compiled = delayed(graph, "linear")
    target = seen_speeds(compiled, 0.7)

    @jax.jit
    def improve(alpha):
        residual = lambda alpha: seen_speeds(compiled, alpha) - target  # noqa: E731
        values, slopes = residual(alpha), jax.jacfwd(residual)(alpha)
        return jnp.clip(alpha - slopes @ values / (slopes @ slopes), 0.0, 1.0)

    alpha = jnp.asarray(0.2)
    for _ in range(12):
        alpha = improve(alpha)
    assert abs(float(alpha) - 0.7) < 1e-6


def test_what_does_not_fit_is_named(graph):
    episodes = graph.generate(1.0)
    with pytest.raises(ValueError, match="no nodes \\['agnet'\\]"):
        graph.compile(episodes, nodes={"agnet": Spring()})
    with pytest.raises(ValueError, match="no connection `world->agent`"):
        graph.compile(episodes, trainable={"world->agent": (0.0, 0.1)})
    with pytest.raises(px.ParallaxError, match="blocking"):
        graph.compile(episodes, trainable={"agent->motor": (0.0, 0.1)})
    demo = px.Graph("pendulum")
    with pytest.raises(ValueError, match="node `world` is no model"):
        demo.compile(demo.generate(1.0))


def test_files_that_nodes_name_become_part_of_the_graph(tmp_path, monkeypatch):
    source = Path(__file__).parents[2] / "examples" / "compensation"
    folder = shutil.copytree(source, tmp_path / "graphs")
    monkeypatch.chdir(tmp_path)
    graph = px.Graph(folder / "graph.toml")
    shutil.rmtree(folder)
    estimator = next(node for node in graph.spec["node"] if node["name"] == "estimator")
    assert "derivative" in estimator["parameters"]["equations"]
    # What holds everything needs the file no more, and compiles to the same numbers.
    again = px.Graph(graph.spec)
    assert again.toml() == graph.toml() == px.Graph(graph.toml()).toml()
    assert again.model("estimator") is not None
    lost = {**graph.spec, "node": [{**estimator, "parameters": {"system": "gone.toml"}}], "connection": []}
    with pytest.raises(ValueError, match=r"gone\.toml"):
        px.Graph(lost)
