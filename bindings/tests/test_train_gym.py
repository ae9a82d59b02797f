"""The environments for gymnasium: its own checker, seeds, and many at once as one by one."""

from __future__ import annotations

import warnings

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from parallax import train as pt
from parallax.train.gym import GymEnvironment, GymVectorEnvironment

pytestmark = pytest.mark.usefixtures("compiled_once")


@pytest.fixture(scope="module")
def environment():
    return pt.GraphEnvironment(
        "pendulum-simulated", pt.PendulumSwingUp(seconds=0.2), episodes=4, spare=0.5, past_actions=2
    )


def test_gymnasium_has_nothing_to_object(environment):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(GymEnvironment(environment), skip_render_check=True)
    # Noise has no bounds, and gymnasium mentions that; it is no objection. Nor is that no registry knows it.
    others = [str(w.message) for w in caught if "infinity" not in str(w.message) and "spec" not in str(w.message)]
    assert not others, others


def test_a_seed_is_an_episode(environment):
    env = GymEnvironment(environment)
    first, _ = env.reset(seed=5)
    moved = env.step(np.array([0.3], np.float32))[0]
    again, _ = env.reset(seed=5)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(moved, env.step(np.array([0.3], np.float32))[0])
    assert np.any(env.reset(seed=6)[0] != first)
    with pytest.raises(gymnasium.error.ResetNeeded):
        GymEnvironment(environment).step(np.zeros(1))


def test_many_are_each_of_them(environment):
    many = GymVectorEnvironment(environment, 3)
    seen, _ = many.reset(seed=1)
    assert seen in many.observation_space
    params = environment.default_params
    keys = jax.random.split(jax.random.key(int(np.random.default_rng(1).integers(2**31))), 3)
    observation, state = jax.vmap(environment.reset_env, (0, None))(keys, params)
    np.testing.assert_allclose(seen, observation, rtol=1e-5, atol=1e-6)
    step = jax.jit(jax.vmap(environment.step_env, (None, 0, 0, None)))
    random = np.random.default_rng(2)
    for place in range(environment.longest):
        actions = random.uniform(-1, 1, (3, 1)).astype(np.float32)
        seen, reward, terminated, truncated, info = many.step(actions)
        observation, state, expected, _, _ = step(keys[0], state, actions, params)
        np.testing.assert_allclose(reward, expected, rtol=1e-3, atol=1e-3)
        assert not terminated.any()
        assert truncated.all() == (place == environment.longest - 1)
        if not truncated.any():
            np.testing.assert_allclose(seen, observation, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(np.stack(list(info["final_obs"])), observation, rtol=1e-3, atol=1e-3)
    assert info["_final_obs"].all()
    assert info["final_info"]["upright"].shape == (3,)
    assert np.any(np.abs(seen - observation) > 0.1)


def test_wrappers_of_gymnasium_go_on_it(environment):
    wrapped = gymnasium.wrappers.vector.RecordEpisodeStatistics(GymVectorEnvironment(environment, 2))
    wrapped.reset(seed=0)
    for _ in range(environment.longest):
        *_, info = wrapped.step(np.zeros((2, 1), np.float32))
    assert "episode" in info or "final_info" in info
