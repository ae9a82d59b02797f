"""What differs from environment to environment: parameters, hidden delays, schedules."""

from __future__ import annotations

import json

import jax
import numpy as np
import pytest

import parallax as px
from parallax import train as pt

pytestmark = pytest.mark.usefixtures("compiled_once")


def drawn(environment, count=2000):
    keys = jax.random.split(jax.random.key(0), count)
    state = jax.jit(jax.vmap(environment.reset_env, (0, None)))(keys, environment.default_params)[1]
    return jax.tree.map(np.asarray, state.graph.params)


def test_parameters_and_hidden_delays_are_drawn_for_every_episode():
    randomisation = pt.Randomisation(
        {
            "world.pendulum.mass": pt.Uniform(0.04, 0.06),
            "world.pendulum.friction": pt.LogUniform(1e-4, 1e-2),
            "encoder.angle_noise": pt.Normal(1e-3, 1e-3, low=0.0),
            "delays.world->encoder": pt.Uniform(0.01, 0.02),
        }
    )
    environment = pt.GraphEnvironment(
        "pendulum-simulated",
        pt.PendulumSwingUp(seconds=0.2),
        episodes=2,
        randomisation=randomisation,
        trainable={"world->encoder": (0.0, 0.04)},
    )
    params = drawn(environment)
    mass = params["world"]["pendulum"]["mass"]
    assert abs(mass.mean() - 0.05) < 5e-4
    assert mass.min() >= 0.04 > mass.min() - 1e-3
    assert abs(np.log10(params["world"]["pendulum"]["friction"]).mean() + 3.0) < 0.05
    assert params["encoder"]["angle_noise"].min() == 0.0
    share = params["delays"]["world->encoder"]
    assert 0.25 <= share.min() < 0.26
    assert 0.49 < share.max() <= 0.5
    # What is not drawn is the graph's.
    assert np.ptp(params["world"]["pendulum"]["length"]) == 0.0


def estimate(name, value, bounds, *places):
    spots = [dict(zip(("node", "parameter"), place.split(".", 1), strict=True)) for place in places]
    return {
        "name": name,
        "sort": "parameter",
        "places": spots,
        "value": value,
        "std": None,
        "bounds": bounds,
        "unit": "",
    }


def test_what_belongs_together_is_drawn_together(tmp_path):
    # J and K are known by their ratio alone; the mass to 1 %.
    widths = np.array([2e-4, 0.03, 0.09]) / np.sqrt(12)
    along, across = np.array([1.0, 1.0, 0.0]) / np.sqrt(2), np.array([1.0, -1.0, 0.0]) / np.sqrt(2)
    scaled = 100.0 * np.outer(along, along) + 1e-4 * np.outer(across, across) + np.diag([0.0, 0.0, 1e-4])
    covariance = scaled * np.outer(widths, widths)
    found = {
        "estimates": [
            estimate("J", 2e-4, [1e-4, 3e-4], "world.pendulum.inertia", "other.inertia"),
            estimate("K", 0.035, [0.02, 0.05], "world.pendulum.motor"),
            estimate("m", 0.05, [0.01, 0.1], "world.pendulum.mass"),
        ],
        "covariance": covariance.ravel().tolist(),
    }
    (tmp_path / "identified.json").write_text(json.dumps(found))
    randomisation = pt.Randomisation.identified(tmp_path)
    assert set(randomisation.places) == {
        "world.pendulum.inertia",
        "other.inertia",
        "world.pendulum.motor",
        "world.pendulum.mass",
    }
    sample = jax.vmap(randomisation.sample)(jax.random.split(jax.random.key(0), 4000))
    inertia, motor = sample["world.pendulum.inertia"], sample["world.pendulum.motor"]
    np.testing.assert_array_equal(inertia, sample["other.inertia"])
    # The direction that the data do not tell is left alone, and across it the spread is what was found.
    z = np.stack([np.asarray(inertia) / widths[0], np.asarray(motor) / widths[1]])
    assert np.std(along[:2] @ z) < 1e-3
    assert abs(np.std(across[:2] @ z) / 1e-2 - 1) < 0.1
    assert abs(np.std(sample["world.pendulum.mass"]) / (1e-2 * widths[2]) - 1) < 0.1
    only = pt.Randomisation.identified(tmp_path, nodes=["other"])
    assert only.places == ["other.inertia"]


def test_schedules_vary_by_more_than_their_own_scatter():
    graph = px.Graph("pendulum-simulated")
    plain = graph.generate(1.0, 8, seed=0)
    varied = pt.varied_episodes(
        graph,
        1.0,
        extra={"encoder->agent.estimator": pt.Uniform(0.0, 0.02), "agent": pt.Normal(0.0, 1e-3)},
        variants=6,
        each=2,
    )
    assert len(varied) == 12

    def late(episodes):
        means = []
        for place in range(len(episodes)):
            episode = episodes.episode(place)
            seen = episode["connections"]["encoder->agent.estimator"]
            known = seen["seq"][:, -1] >= 0
            sent = episode["nodes"]["encoder"]["end"][seen["seq"][known, -1]]
            means.append(np.mean(seen["received"][known, -1] - sent) * 1e-9)
        return np.array(means)

    assert np.std(late(plain)) < 1e-4
    assert np.std(late(varied)) > 2e-3
    environment = pt.GraphEnvironment(graph, pt.PendulumSwingUp(seconds=0.5), episodes=varied)
    assert environment.compiled.episodes == 12
    with pytest.raises(ValueError, match="neither a connection nor a node"):
        pt.varied_episodes(graph, 1.0, extra={"nobody": pt.Uniform(0, 1)}, variants=1)


def test_a_hidden_delay_that_scatters_scatters_in_training(tmp_path):
    graph = px.Graph("pendulum-simulated")

    def delay(of, value, std):
        place = {"from": "motor", "to": "world", "port": "motor", "of": of}
        return {"name": "actuator", "places": [place], "value": value, "std": std}

    def lateness(*estimates, humps=()):
        (tmp_path / "identified.json").write_text(json.dumps({"estimates": estimates, "humps": humps}))
        varied = pt.varied_episodes(graph, 3.0, identified=tmp_path, variants=10, each=1)
        late = []
        for place in range(len(varied)):
            episode = varied.episode(place)
            seen = episode["connections"]["motor->world"]
            first = np.unique(seen["seq"][:, -1], return_index=True)[1]
            first = first[seen["seq"][first, -1] >= 0]
            sent = episode["nodes"]["motor"]["end"][seen["seq"][first, -1]]
            late.append((seen["received"][first, -1] - sent) * 1e-9)
        return np.array([np.mean(each) for each in late]), np.array([np.std(each) for each in late])

    # Of messages 20 ms apart none overtakes another.
    means, spreads = lateness(delay("spread", 2e-3, 0.0), delay("mean", 0.03, 1e-3))
    assert abs(np.mean(means) - 0.03) < 1.5e-3
    assert 4e-4 < np.std(means) < 2.5e-3
    assert np.all(np.abs(spreads / 2e-3 - 1) < 0.3), spreads
    # Two humps, 6 ms apart, that are moved with the mean.
    known = lambda value: {"value": value, "std": 0.0}  # noqa: E731
    hump = lambda mean: {"share": known(0.5), "mean": known(mean), "spread": known(1e-4)}  # noqa: E731
    two = {"delay": "actuator", "places": [delay("mean", 0, 0)["places"][0]], "humps": [hump(0.027), hump(0.033)]}
    means, spreads = lateness(delay("spread", 3e-3, 0.0), delay("mean", 0.03, 1e-3), humps=[two])
    assert abs(np.mean(means) - 0.03) < 1.5e-3
    # Nearly everything is 3 ms from the mean, which a normal distribution does not do.
    assert np.all(np.abs(spreads / 3e-3 - 1) < 0.1), spreads
    # Without a spread every message of an episode takes as long.
    means, spreads = lateness(delay("mean", 0.03, 1e-3))
    assert np.std(means) > 4e-4
    assert np.all(spreads < 1e-6), spreads
    with pytest.raises(ValueError, match="no hidden delay of a connection of this graph"):
        pt.varied_episodes(px.Graph("quadrotor-simulated"), 1.0, identified=tmp_path, variants=1)


def test_what_is_drawn_twice_is_refused():
    with pytest.raises(ValueError, match="drawn twice"):
        pt.Randomisation(
            {"world.mass": pt.Uniform(0, 1)},
            [pt.Joint((("world.mass",),), np.zeros(1), np.ones((1, 1)), np.zeros(1), np.ones(1))],
        )
    with pytest.raises(ValueError, match="must not be greater"):
        pt.Uniform(1.0, 0.0)
