"""Compiled graphs over several devices and processes, and programs kept between processes."""

from __future__ import annotations

import os
import socket
import subprocess
import sys

ROLL = """
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P

import parallax as px

graph = px.Graph("pendulum-simulated")
compiled = graph.compile(graph.generate(1.0, episodes=4, seed=0))

def roll(key, episode, mass, tables):
    state = compiled.init(key, episode=episode)
    state.params["world"]["pendulum"]["mass"] = mass
    return compiled.rollout(state, tables=tables)[0].state["world"]["angle"]

batch = jax.vmap(roll, (0, 0, 0, None))
keys = jax.random.split(jax.random.key(0), 16)
episodes = jnp.arange(16) % 4
masses = jnp.linspace(0.04, 0.06, 16)
"""

SHARDED = (
    ROLL
    + """
assert len(jax.devices()) == 4, jax.devices()
mesh = Mesh(np.array(jax.devices()), ("environments",))
split, whole = NamedSharding(mesh, P("environments")), NamedSharding(mesh, P())
arguments = [jax.device_put(x, split) for x in (keys, episodes, masses)]
sharded = jax.jit(batch, in_shardings=(split, split, split, whole), out_shardings=split)(*arguments, compiled.tables)
assert len(sharded.sharding.device_set) == 4
assert {shard.data.shape for shard in sharded.addressable_shards} == {(4,)}
alone = jax.jit(batch)(keys, episodes, masses, compiled.tables)
np.testing.assert_allclose(sharded, alone, rtol=2e-3, atol=2e-3)
print("sharded", len(sharded.sharding.device_set))
"""
)

DISTRIBUTED = """
import sys
import jax
jax.distributed.initialize(sys.argv[1], num_processes=2, process_id=int(sys.argv[2]))
""" + (
    ROLL
    + """
assert jax.process_count() == 2 and len(jax.devices()) == 4 and len(jax.local_devices()) == 2
mesh = Mesh(np.array(jax.devices()), ("environments",))
split, whole = NamedSharding(mesh, P("environments")), NamedSharding(mesh, P())

def spread(x, sharding):
    return jax.make_array_from_callback(np.shape(x), sharding, lambda place: np.asarray(x)[place])

data = np.asarray(jax.random.key_data(keys))
tables = jax.tree.map(lambda table: spread(table, whole), compiled.tables)
run = jax.jit(
    lambda data, *rest: batch(jax.random.wrap_key_data(data), *rest),
    in_shardings=(split, split, split, whole),
    out_shardings=split,
)
ours = run(spread(data, split), spread(episodes, split), spread(masses, split), tables)
alone = np.asarray(jax.jit(batch)(keys, episodes, masses, compiled.tables))
seen = 0
for shard in ours.addressable_shards:
    np.testing.assert_allclose(shard.data, alone[shard.index], rtol=2e-3, atol=2e-3)
    seen += shard.data.shape[0]
assert seen == 8, seen
print("distributed", seen)
"""
)

CACHED = (
    """
import os
import jax
import parallax as px
px.use_compilation_cache(least_seconds=0.0)
"""
    + ROLL
    + """
hits = []
from jax import monitoring
monitoring.register_event_listener(lambda event, **_: hits.append(event))
jax.jit(batch)(keys, episodes, masses, compiled.tables).block_until_ready()
folder = os.environ["PARALLAX_CACHE"]
print("files", len(os.listdir(folder)), "hits", hits.count("/jax/compilation_cache/cache_hits"),
      "misses", hits.count("/jax/compilation_cache/cache_misses"))
"""
)


def start(code: str, *arguments: str, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        env=os.environ | {"JAX_PLATFORMS": "cpu"} | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> str:
    out, _ = process.communicate(timeout=240)
    assert process.returncode == 0, out
    return out


def test_environments_are_sharded_over_devices():
    assert "sharded 4" in finish(start(SHARDED, XLA_FLAGS="--xla_force_host_platform_device_count=4"))


def test_environments_are_spread_over_processes():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    flags = "--xla_force_host_platform_device_count=2"
    processes = [start(DISTRIBUTED, address, str(place), XLA_FLAGS=flags) for place in range(2)]
    for process in processes:
        assert "distributed 8" in finish(process)


def test_the_next_process_compiles_nothing(tmp_path):
    first = finish(start(CACHED, PARALLAX_CACHE=str(tmp_path)))
    files = len(os.listdir(tmp_path))
    assert files > 0
    second = finish(start(CACHED, PARALLAX_CACHE=str(tmp_path)))
    numbers = [int(word) for word in second.split() if word.isdigit()]
    assert "misses 0" not in first
    assert numbers[0] == files
    assert numbers[1] > 0
    assert "misses 0" in second


def test_the_default_folder_is_the_users(tmp_path):
    code = "import parallax as px; print(px.use_compilation_cache())"
    out = finish(start(code, XDG_CACHE_HOME=str(tmp_path), PARALLAX_CACHE=""))
    assert out.strip() == str(tmp_path / "parallax" / "jax")
