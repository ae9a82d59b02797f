"""Identification from Python: by the native search, and by evolution on a compiled graph."""

from __future__ import annotations

import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import parallax as px
from conftest import ROOT, _program

SPECIFICATION = ROOT / "examples" / "identify" / "pendulum.toml"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("identify") / "run.mcap"
    command = [_program(), "sim", "pendulum", "--duration", "10", "--seed", "1", "--out", path]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    return path


def test_what_the_command_line_finds_is_there_in_python(recording, tmp_path):
    found = px.identify(recording, SPECIFICATION, tmp_path / "out", parallax=_program())
    # What the world is: nodes/src/pendulum/world.rs.
    assert abs(found["J"] / 1.62e-4 - 1) < 0.03
    assert abs(found["K"] / 0.0337 - 1) < 0.03
    estimate = found.estimates["J"]
    assert estimate.interval[0] < estimate.value < estimate.interval[1]
    place = list(found.estimates).index("J")
    assert np.sqrt(found.covariance[place, place]) == pytest.approx(estimate.std)
    assert found.graph.spec["name"] == "pendulum"
    with pytest.raises(KeyError, match="nothing was identified as `mass`; there is"):
        found["mass"]


def test_what_the_command_line_refuses_is_an_error(recording, tmp_path):
    wrong = SPECIFICATION.read_text().replace("world.pendulum.motor", "world.pendulum.moter")
    with pytest.raises(px.CommandError, match="moter"):
        px.identify(recording, wrong, tmp_path, parallax=_program())
    with pytest.raises(px.CommandError, match="/no/such"):
        px.identify(recording, SPECIFICATION, tmp_path, parallax="/no/such")


@pytest.fixture(scope="module")
def mismatch():
    """How far a rollout of the pendulum's loop is from one with another inertia and motor constant."""
    graph = px.Graph("pendulum-simulated")
    compiled = graph.compile(graph.generate(1.2, episodes=1))

    def angles(inertia, motor):
        state = compiled.init(jax.random.key(0))
        state.params["world"]["pendulum"]["inertia"] = inertia
        state.params["world"]["pendulum"]["motor"] = motor
        return compiled.rollout(state, record=lambda state: state.state["world"]["angle"])[1]

    seen = jax.jit(angles)(2.1e-4, 0.028)
    return lambda point: jnp.mean((angles(point["J"], point["K"]) - seen) ** 2)


@pytest.mark.parametrize("strategy", ["CMA_ES", "DifferentialEvolution"])
def test_strategies_of_evosax_find_it_on_a_compiled_graph(mismatch, strategy):
    bounds = {"J": (8e-5, 3.2e-4), "K": (0.02, 0.05)}
    found = px.evolve(mismatch, bounds, strategy=strategy, population=24, generations=40)
    assert abs(found.best["J"] / 2.1e-4 - 1) < 0.02
    assert abs(found.best["K"] / 0.028 - 1) < 0.02
    assert found.losses.shape == (40,)
    assert np.all(np.diff(found.losses) <= 0.0)
    assert found.loss == found.losses[-1]


def test_what_cannot_be_evolved_is_said():
    with pytest.raises(ValueError, match=r"`a` is to lie between 1.0 and 1.0"):
        px.evolve(lambda point: point["a"], {"a": (1.0, 1.0)})
    with pytest.raises(ValueError, match="nothing is unknown"):
        px.evolve(lambda point: 0.0, {})
    with pytest.raises(ValueError, match="no algorithm `Simplex`; it has"):
        px.evolve(lambda point: point["a"], {"a": (0.0, 1.0)}, strategy="Simplex")


def test_a_loss_that_is_no_number_is_the_worst():
    found = px.evolve(lambda point: jnp.sqrt(point["a"] - 0.5), {"a": (0.0, 1.0)}, population=16, generations=20)
    assert 0.5 <= found.best["a"] < 0.55
