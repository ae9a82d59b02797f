"""The environment is one of gymnax: what gymnax itself makes of it is what it makes of itself."""

from __future__ import annotations

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from parallax import train as pt

gymnax = pytest.importorskip("gymnax")
pytestmark = pytest.mark.usefixtures("compiled_once")


@pytest.fixture(scope="module")
def environment():
    task = pt.PendulumSwingUp(seconds=0.2)
    return pt.GraphEnvironment("pendulum-simulated", task, episodes=4, spare=0.5, past_actions=2)


@pytest.fixture(scope="module")
def theirs(environment):
    from parallax.train.gymnax import GymnaxEnvironment

    return GymnaxEnvironment(environment)


def test_the_calls_are_those_of_gymnax(environment, theirs):
    reference, params = gymnax.make("Pendulum-v1")
    assert isinstance(theirs, gymnax.environments.environment.Environment)
    for name in ("reset", "step", "reset_env", "step_env", "is_truncated"):
        expected = [*inspect.signature(getattr(reference, name)).parameters]
        assert [*inspect.signature(getattr(environment, name)).parameters] == expected, name
        assert [*inspect.signature(getattr(theirs, name)).parameters] == expected, name
    for made, own in ((environment, environment.default_params), (theirs, theirs.default_params)):
        shapes = [
            jax.eval_shape(lambda key, env=env, of=of: _one_step(env, key, of), jax.random.key(0))
            for env, of in ((reference, params), (made, own))
        ]
        expected, found = shapes
        assert len(found) == len(expected)
        # Reward, whether it is terminated, whether it is truncated: the same types. The rest is the environment's own.
        assert [(x.shape, x.dtype) for x in found[2:5]] == [(x.shape, x.dtype) for x in expected[2:5]]
        assert {"terminated", "truncated", "final_observation"} <= set(found[5])
        assert found[0].shape == made.observation_space(own).shape
        assert found[0].dtype == made.observation_space(own).dtype
    assert isinstance(theirs.action_space(), gymnax.environments.spaces.Box)


def _one_step(env, key, params):
    observation, state = env.reset(key, params)
    action = env.action_space(params).sample(key)
    return env.step(key, state, action, params) if observation is not None else None


def test_an_episode_ends_and_begins_as_gymnax_has_it(environment, theirs):
    params, copies, steps = environment.default_params, 3, 2 * environment.longest + 3

    def rollout(env, key):
        first, state = env.reset(key, params)

        def step(state, key):
            of_action, of_step = jax.random.split(key)
            action = env.action_space(params).sample(of_action)
            seen, state, reward, terminated, truncated, info = env.step(of_step, state, action, params)
            return state, (seen, reward, terminated, truncated, info["final_observation"], state.time)

        return first, jax.lax.scan(step, state, jax.random.split(key, steps))[1]

    keys = jax.random.split(jax.random.key(1), copies)
    ours, of_gymnax = (jax.jit(jax.vmap(lambda key, env=env: rollout(env, key)))(keys) for env in (environment, theirs))
    for mine, other in zip(jax.tree.leaves(ours), jax.tree.leaves(of_gymnax), strict=True):
        np.testing.assert_array_equal(mine, other)
    first, (seen, _, terminated, truncated, final, time) = ours
    assert not terminated.any()
    ends = np.flatnonzero(truncated[0])
    np.testing.assert_array_equal(ends, [environment.longest - 1, 2 * environment.longest - 1])
    assert (time[:, ends] == 0).all()
    # What is seen then belongs to the new episode, and what was seen last is kept.
    assert (np.abs(seen[:, ends] - final[:, ends]).max(axis=-1) > 1e-3).all()
    others = np.setdiff1d(np.arange(steps), ends)
    np.testing.assert_array_equal(seen[:, others], final[:, others])
    assert len(np.unique(first[:, 0])) == copies


def test_its_wrappers_go_on_it(environment, theirs):
    from gymnax.wrappers import FlattenObservationWrapper, LogWrapper

    wrapped = LogWrapper(FlattenObservationWrapper(theirs))
    params = theirs.default_params
    key = jax.random.key(2)
    seen, state = wrapped.reset(key, params)
    assert seen.shape == wrapped.observation_space(params).shape
    total = 0.0
    for place in range(environment.longest):
        seen, state, reward, _, truncated, info = wrapped.step(
            jax.random.fold_in(key, place), state, jnp.zeros(theirs.num_actions), params
        )
        total += float(reward)
    assert truncated
    assert info["returned_episode"]
    assert int(info["returned_episode_lengths"]) == environment.longest
    assert float(info["returned_episode_returns"]) == pytest.approx(total, rel=1e-5)
    inner = state.env_state
    np.testing.assert_array_equal(theirs.observe(key, inner, None, params), seen)
    assert not theirs.is_terminated(inner, params)
