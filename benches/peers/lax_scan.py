"""A plain `lax.scan` over the bare dynamics: what JAX itself reaches, without a graph and without delays."""

import common

chosen = common.options(dtypes="f32,f64")

import jax

import models


def rollout(model, dt):
    """Parameters, first states and actions of all environments to last states."""

    def step(p, x, u):
        for _ in range(2):
            x = models.rk4(model.derivative, p, x, u, dt)
        return x

    return jax.jit(lambda p, x, us: jax.lax.scan(lambda x, u: (step(p, x, u), None), x, us)[0])


def main():
    peer = f"lax.scan, jax {jax.__version__}"
    for model in models.MODELS:
        for dtype in chosen.dtype:
            jax.config.update("jax_enable_x64", dtype == "f64")
            number = common.number(dtype)
            run = rollout(model, number(common.STEP))
            for envs in chosen.envs:
                work = jax.device_put(
                    (model.parameters(envs, number), model.state(envs, number), model.actions(envs, number))
                )
                if envs == 1:  # a rank of its own would cost something
                    work = jax.tree_util.tree_map(lambda a: a[..., 0], work)
                seconds = common.measure(lambda: jax.block_until_ready(run(*work)), chosen)
                common.throughput(peer, f"{model.name}, bare", dtype, envs, common.STEPS, seconds)


main()
