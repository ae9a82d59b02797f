"""Training: what the policy sees, how advantages are made, exact resumption, and that it learns."""

from __future__ import annotations

import json
import math
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import parallax as px
from parallax import train as pt

pytestmark = pytest.mark.usefixtures("compiled_once")

SMALL = pt.PPO(total_steps=4 * 8 * 16, environments=8, rollout_steps=16, minibatches=4, epochs=2, hidden=(8,))


@pytest.fixture(scope="module")
def environment():
    task = pt.PendulumSwingUp(seconds=0.5)
    return pt.GraphEnvironment("pendulum-simulated", task, episodes=4, spare=0.5, past_observations=2, past_actions=1)


def test_the_policy_sees_the_present_and_then_the_past(environment, x64):
    params = environment.default_params
    reset, step = jax.jit(environment.reset_env), jax.jit(environment.step_env)
    seen, state = reset(jax.random.key(3), params)
    assert environment.interface.names[2:5] == ["speed", "cos(angle)[-1]", "sin(angle)[-1]"]
    assert seen.shape == (environment.interface.size,) == (10,)
    np.testing.assert_array_equal(seen[3:9], np.tile(seen[:3], 2))
    assert seen[9] == 0.0
    observations, sent = [seen[:3]], [0.0]
    for share in (0.5, -0.25, 2.0):
        seen, state, _, _, _ = step(jax.random.key(0), state, jnp.asarray([share]), params)
        observations.append(seen[:3])
        sent.append(4.0 * min(share, 1.0))
        before = observations[max(0, len(observations) - 3)]
        np.testing.assert_array_equal(seen, np.concatenate([observations[-1], observations[-2], before, [sent[-1]]]))


def test_what_is_observed_is_what_the_graph_delivers(environment, x64):
    # The same graph, stepped by hand with the same schedule, key and start.
    params = environment.default_params
    _, state = jax.jit(environment.reset_env)(jax.random.key(3), params)
    step = jax.jit(environment.compiled.step)
    graph = state.graph
    for share in (0.5, -0.25):
        seen, state, *_ = jax.jit(environment.step_env)(jax.random.key(0), state, jnp.asarray([share]), params)
        graph, by_hand = step(graph, {"voltage": jnp.asarray(4.0 * share)}, params.tables)
        message = by_hand.inputs["estimator"]["message"]
        np.testing.assert_array_equal(seen[2], message["speed"][-1])
        np.testing.assert_allclose(seen[:2], [np.cos(message["angle"][-1]), np.sin(message["angle"][-1])], rtol=1e-15)


def test_every_episode_has_its_own_schedule_and_start(environment):
    keys = jax.random.split(jax.random.key(0), 64)
    seen, state = jax.jit(jax.vmap(environment.reset_env, (0, None)))(keys, environment.default_params)
    assert set(np.asarray(state.graph.episode)) == {0, 1, 2, 3}
    assert len(np.unique(np.asarray(state.graph.step))) > 5
    assert len(np.unique(np.asarray(seen[:, 2]))) == 64
    # The first message shows where the pendulum is, not where it hung before: to what it turns in a few steps.
    angle = np.asarray(state.graph.state["world"]["angle"])
    error = np.abs(np.angle(np.exp(1j * (angle - np.arctan2(seen[:, 1], seen[:, 0])))))
    assert np.max(error) < 0.5


def test_the_end_of_the_time_is_not_the_end(environment):
    params = environment.default_params
    step = jax.jit(environment.step)
    seen, state = environment.reset(jax.random.key(0), params)
    for place in range(environment.longest):
        seen, state, _, terminated, truncated, info = step(
            jax.random.key(place), state, environment.action_space().sample(jax.random.key(place)), params
        )
    assert truncated
    assert not terminated
    assert state.time == 0
    assert np.any(info["final_observation"] != seen)


def by_the_definition(reward, value, after, terminated, done, discount, trace):
    """Sums of errors, as they are written down in the paper."""
    result = np.zeros_like(reward)
    steps, environments = reward.shape
    for environment in range(environments):
        for start in range(steps):
            weight, total = 1.0, 0.0
            for step in range(start, steps):
                worth = 0.0 if terminated[step, environment] else after[step, environment]
                total += weight * (reward[step, environment] + discount * worth - value[step, environment])
                if done[step, environment]:
                    break
                weight *= discount * trace
            result[start, environment] = total
    return result


def test_advantages_stop_at_resets_and_count_what_a_time_limit_cuts_off(x64):
    random = np.random.default_rng(0)
    reward, value, after = random.normal(size=(3, 12, 5))
    terminated = random.random((12, 5)) < 0.15
    done = terminated | (random.random((12, 5)) < 0.15)
    assert np.any(done & ~terminated)
    assert np.any(terminated)
    found = pt.advantages(*map(jnp.asarray, (reward, value, after, terminated, done)), 0.9, 0.8)
    np.testing.assert_allclose(found, by_the_definition(reward, value, after, terminated, done, 0.9, 0.8), atol=1e-12)


class Corridor:
    """A task whose every step is worth one, so that its value is known: 1/(1 − γ), for ever."""

    observations = ("speed",)
    actions = {"voltage": (-1.0, 1.0)}  # noqa: RUF012
    seconds = 0.2

    def __init__(self, ends):
        self.ends = ends

    def start(self, key, state):
        return state

    def reward(self, before, last, action, after):
        return jnp.asarray(1.0)

    def terminated(self, state):
        return jnp.asarray(self.ends) & (state.step % 10 == 0)

    def metrics(self, state):
        return {}


@pytest.mark.parametrize("ends", [False, True])
def test_values_converge_to_what_goes_on(ends):
    # One for every step, for ever; or, with an end after up to ten steps from a random start, the mean over the steps
    # that are left, of which 11 − n episodes have n.
    left = np.arange(1, 11)
    worth = np.sum((11 - left) * (1 - 0.9**left) * 10) / np.sum(left) if ends else 10.0
    environment = pt.GraphEnvironment("pendulum-simulated", Corridor(ends), episodes=2, spare=0.3)
    settings = pt.PPO(
        total_steps=40_000,
        environments=32,
        rollout_steps=20,
        minibatches=4,
        epochs=8,
        hidden=(8,),
        learning_rate=5e-3,
        discount=0.9,
        normalise_rewards=False,
        clip_value=False,
    )
    learner = pt.Learner(environment, settings)
    params = environment.default_params
    state = learner.init(jax.random.key(0), params)
    state = jax.lax.fori_loop(0, settings.updates, lambda _, s: learner.update(s, params)[0], state)
    normal = learner._normal(state.seen, state.inputs)
    value = px.train.network.evaluate(state.network["critic"], normal, "tanh")[:, 0]
    # A time limit that counts as an end, or an end that does not, is wrong by a third or more.
    assert abs(float(np.mean(value)) - worth) < 0.1 * worth


def same(one, other):
    data = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x  # noqa: E731
    for first, second in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(data(first), data(second))


def test_a_training_goes_on_bit_for_bit(environment, tmp_path):
    whole = pt.train(environment, SMALL, seeds=(1, 2), evaluations=4, evaluation_episodes=2, progress=False)
    folder = tmp_path / "half"

    def enough(row):
        if row["steps"] >= SMALL.batch * 2:
            raise KeyboardInterrupt

    half = pt.train(
        environment,
        SMALL,
        seeds=(1, 2),
        folder=folder,
        evaluations=4,
        evaluation_episodes=2,
        progress=False,
        stop=enough,
    )
    assert half.rows[-1]["steps"] == 2 * SMALL.batch
    assert not half.finished
    rest = pt.train(
        environment,
        SMALL,
        seeds=(1, 2),
        folder=folder,
        resume=True,
        evaluations=4,
        evaluation_episodes=2,
        progress=False,
    )
    assert rest.finished
    same(whole.state, rest.state)
    assert [row["return"] for row in whole.rows] == [row["return"] for row in rest.rows]
    assert rest.rows[-1]["steps"] == 4 * SMALL.batch
    assert [json.loads(line)["steps"] for line in (folder / "log.jsonl").read_text().splitlines()] == [
        row["steps"] for row in rest.rows
    ]
    for name in ("curves.svg", "policy.safetensors", "policy-1.safetensors", "policy-2.safetensors"):
        assert (folder / name).exists()

    with pytest.raises(pt.CheckpointError, match="learning_rate"):
        pt.train(environment, SMALL.changed(learning_rate=1.0), seeds=(1, 2), folder=folder, resume=True)
    with pytest.raises(pt.CheckpointError, match="seeds"):
        pt.train(environment, SMALL, seeds=(1, 3), folder=folder, resume=True)
    other = pt.GraphEnvironment("pendulum-simulated", environment.task, episodes=4, seed=1, spare=0.5)
    with pytest.raises(pt.CheckpointError, match=r"environment \(inputs, schedules\)"):
        pt.train(other, SMALL, seeds=(1, 2), folder=folder, resume=True)
    (folder / "checkpoint.safetensors").write_bytes(b"nothing")
    with pytest.raises(pt.CheckpointError, match="cannot be read"):
        pt.train(environment, SMALL, seeds=(1, 2), folder=folder, resume=True)


def test_layers_of_several_seeds_do_not_wait_for_each_other():
    """Batches of decompositions wait for XLA's threads on one of them; with few cores a training never began."""
    program = """
import jax, parallax
from parallax.train import network
draw = jax.jit(jax.vmap(lambda key: network.initial(key, 8, (64, 64), 1, 0.0)))
keys = jax.random.split(jax.random.key(0), 3)
for _ in range(1000):
    jax.block_until_ready(draw(keys))
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


def test_seeds_do_not_meet(environment):
    settings = SMALL.changed(total_steps=SMALL.batch)
    both = pt.train(environment, settings, seeds=(1, 2), evaluations=1, evaluation_episodes=2, progress=False)
    alone = pt.train(environment, settings, seeds=(2,), evaluations=1, evaluation_episodes=2, progress=False)
    first = jax.tree.leaves(jax.tree.map(lambda leaf: leaf[1], both.state.network))
    for one, other in zip(first, jax.tree.leaves(jax.tree.map(lambda leaf: leaf[0], alone.state.network)), strict=True):
        # Matrices are multiplied in another order; single precision.
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4)
    assert np.any(both.policies[0].weights[0] != both.policies[1].weights[0])
    assert both.policies[0].weights[0].shape == (8, 10)


class Hold:
    """Keep the voltage at what the speed's sign says: learnt in a few thousand steps, or something is wrong."""

    observations = ("speed",)
    actions = {"voltage": (-1.0, 1.0)}  # noqa: RUF012
    seconds = 0.4

    def start(self, key, state):
        speed = jax.random.uniform(key, (), float, -5.0, 5.0)
        state = pt.with_state(state, "world", {"angle": math.pi, "speed": speed})
        return pt.with_state(state, "world", {"speed": speed}, ["world", "encoder"])

    def reward(self, before, last, action, after):
        return -((action[0] - jnp.tanh(before.state["world"]["speed"])) ** 2)

    def terminated(self, state):
        return jnp.asarray(False)

    def metrics(self, state):
        return {}


def test_it_learns():
    environment = pt.GraphEnvironment("pendulum-simulated", Hold(), episodes=4, spare=0.3)
    settings = pt.PPO(
        total_steps=40_000,
        environments=32,
        rollout_steps=20,
        minibatches=4,
        epochs=8,
        hidden=(16,),
        learning_rate=3e-3,
        entropy=0.0,
        discount=0.5,
    )
    training = pt.train(environment, settings, evaluations=2, progress=False)
    assert training.finished
    assert training.rows[0]["return"][0] < -5.0
    assert training.rows[-1]["return"][0] > -1.0
    assert training.steps_per_second > 0


def test_what_does_not_fit_is_named():
    class Wrong(Hold):
        observations = ("sped",)

    with pytest.raises(ValueError, match="observes `sped`; `agent` receives angle, speed, stamp"):
        pt.GraphEnvironment("pendulum-simulated", Wrong(), episodes=1)
    with pytest.raises(ValueError, match="no node `wold`"):
        pt.GraphEnvironment(
            "pendulum-simulated", Hold(), episodes=1, randomisation=pt.Randomisation({"wold.mass": pt.Uniform(0, 1)})
        )
    with pytest.raises(ValueError, match=r"there is no `maas`; there is .*mass"):
        pt.GraphEnvironment(
            "pendulum-simulated",
            Hold(),
            episodes=1,
            randomisation=pt.Randomisation({"world.pendulum.maas": pt.Uniform(0, 1)}),
        )
    with pytest.raises(ValueError, match="no trainable delay"):
        pt.GraphEnvironment(
            "pendulum-simulated",
            Hold(),
            episodes=1,
            randomisation=pt.Randomisation({"delays.world->encoder": pt.Uniform(0, 0.01)}),
        )
    with pytest.raises(ValueError, match="16 minibatches do not divide"):
        pt.PPO(environments=3, rollout_steps=5)


def test_the_quadrotor_flies_its_circle_or_the_episode_is_over():
    environment = pt.GraphEnvironment("quadrotor-simulated", pt.QuadrotorCircle(seconds=1.0), episodes=2)
    assert environment.interface.names == [
        *("position.x", "position.y", "position.z"),
        *("velocity.x", "velocity.y", "velocity.z"),
        *("attitude.roll", "attitude.pitch"),
    ]
    params = environment.default_params
    seen, state = jax.jit(environment.reset_env)(jax.random.key(0), params)
    world = state.graph.state["world"]
    assert abs(np.hypot(world["position"]["x"], world["position"]["y"]) - 1.0) < 0.45
    np.testing.assert_allclose(seen[0], world["position"]["x"], atol=0.05)
    step = jax.jit(environment.step_env)
    # Level, it drifts; at full tilt it is gone within a second.
    ended = []
    for share in ([0.0, 0.0, 0.0], [1.0, 1.0, 0.0]):
        own, over = state, False
        for _ in range(environment.longest):
            _, own, reward, terminated, metrics = step(jax.random.key(0), own, jnp.asarray(share), params)
            assert np.isfinite(reward)
            over = over or bool(terminated)
        ended.append((over, float(metrics["error"])))
    assert not ended[0][0]
    assert ended[1][1] > ended[0][1] + 0.5


def test_circles_of_other_radii_are_compiled_once():
    made = [
        pt.GraphEnvironment("quadrotor-simulated", pt.QuadrotorCircle(radius=radius), episodes=1)
        for radius in (1.0, 0.5)
    ]
    key, params = jax.random.key(0), [environment.default_params for environment in made]
    resets = [jax.jit(environment.reset_env) for environment in made]
    assert len({reset.lower(key, own).as_text() for reset, own in zip(resets, params, strict=True)}) == 1
    for radius, own in zip((1.0, 0.5), params, strict=True):
        place = resets[0](key, own)[1].graph.state["world"]["position"]
        assert abs(np.hypot(place["x"], place["y"]) / radius - 1.0) < 0.41
