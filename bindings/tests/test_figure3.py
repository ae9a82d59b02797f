"""A graph of nodes that Python wrote down, on the wall clock, under the simulated clock, and compiled."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robot

import parallax as px
from conftest import ROOT, _program


def ran(clock, steps=20, seed=3, **arguments):
    """The recording of so many steps, with the last state and the report."""
    supervisor, nodes = robot.loop(**arguments)
    graph = px.Graph(supervisor, nodes, clock=clock)
    graph.warmup()
    state = graph.init(seed=seed)
    for _ in range(steps):
        state = graph.run(state)
    report = graph.stop()
    return graph, graph.get_record(), state, report


def steps(graph, state, count):
    """The state after so many steps."""
    for _ in range(count):
        state = graph.run(state)
    return state


def agrees(recording, weight=0.5, first=0):
    """Every message is what its node makes of what it consumed."""
    cam, agent, log = recording["cam"], recording["agent"], recording["log"]
    pictures = cam.tree["place"]
    assert isinstance(pictures, robot.Place)
    assert pictures.position.shape == (len(cam.seq), 2, 3)
    np.testing.assert_array_equal(pictures.position[:, 1, 2], 5.0 + cam.seq)
    np.testing.assert_array_equal(pictures.count, cam.seq)
    np.testing.assert_array_equal(cam.tree["exact"], 16_777_217 + cam.seq)
    np.testing.assert_array_equal(cam.tree["seen"][0], cam.seq % 2 == 1)
    seen = agent.inputs["cam"].seq[:, -1]
    corner = np.where(seen < 0, 0.0, 5.0 + seen)
    expected = weight * corner + first + np.arange(len(agent.seq))
    np.testing.assert_allclose(agent["voltage"], expected[: len(agent.seq)], rtol=1e-6)
    voltages = np.append(agent["voltage"], 0.25)
    np.testing.assert_array_equal(log.tree["voltages"], voltages[log.inputs["agent"].seq])
    shown = log.inputs["cam"].seq[:, -1]
    np.testing.assert_array_equal(log["corner"], np.where(shown < 0, 0.0, 5.0 + shown))
    np.testing.assert_array_equal(log.tree["exact"], np.where(shown < 0, 7, 16_777_217 + shown))
    np.testing.assert_array_equal(log.tree["steps"], 1 + np.arange(len(log.seq)))


def test_on_the_wall_clock_every_node_is_a_process():
    _, recording, state, report = ran(px.WALL_CLOCK)
    assert state.step == 20
    assert int(state.state["agent"]["steps"]) == 20
    assert len(recording["agent"].seq) == 20
    agrees(recording)
    assert recording["log"]["process"][0] != os.getpid()
    assert {node["node"]: node["exit"] for node in report["nodes"]} == dict.fromkeys(recording.nodes, "clean")
    assert 19 / 30 < state.time < 5.0


def test_under_the_simulated_clock_a_seed_gives_the_same_bits(tmp_path):
    files = [tmp_path / "one.mcap", tmp_path / "two.mcap"]
    for file in files:
        supervisor, nodes = robot.loop()
        graph = px.Graph(supervisor, nodes, clock=px.SIMULATED)
        state = graph.init(seed=3, recording=file)
        for _ in range(20):
            state = graph.run(state)
        graph.stop()
        agrees(graph.get_record())
        assert graph.get_record()["log"]["process"][0] == os.getpid()
    assert files[0].read_bytes() == files[1].read_bytes()


def test_the_command_line_makes_the_same_run(tmp_path, monkeypatch):
    supervisor, nodes = robot.loop()
    graph = px.Graph(supervisor, nodes, clock=px.SIMULATED)
    here = graph.simulate(tmp_path / "here.mcap", 1.0, seed=3)
    (tmp_path / "graph.toml").write_text(graph.toml())
    (tmp_path / "launch.toml").write_text(f'[defaults]\ninterpreter = "{sys.executable}"\n')
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "bindings" / "tests"))
    command = [_program(), "sim", tmp_path / "graph.toml", "--duration", "1", "--seed", "3", "--out"]
    done = subprocess.run([*command, tmp_path / "there.mcap"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    there = px.load(tmp_path / "there.mcap")
    for name in ("cam", "agent", "motor"):
        np.testing.assert_array_equal(here[name].payload, there[name].payload)
        np.testing.assert_array_equal(here[name].start_ns, there[name].start_ns)
    # The same graph.toml is a graph of these nodes for Python, too.
    again = px.Graph(tmp_path / "graph.toml", clock=px.SIMULATED).simulate(tmp_path / "again.mcap", 1.0, seed=3)
    np.testing.assert_array_equal(again["agent"].payload, here["agent"].payload)


def test_what_ran_is_compiled_and_gives_the_same_numbers():
    _, recording, _, _ = ran(px.SIMULATED)
    supervisor, nodes = robot.loop()
    flow = recording.to_graph().augment([node for node in nodes if node.name != "log"])
    compiled = px.Graph(supervisor, nodes, clock=px.SIMULATED).compile(flow)
    states = jax.vmap(compiled.init)(jax.random.split(jax.random.key(0), 3))
    states.params["agent"]["weight"] = jnp.array([0.5, 0.25, -1.0])

    def rollout(state):
        return compiled.rollout(state, record=lambda state: state.history["agent"][0]["voltage"])[1]

    voltages = jax.jit(jax.vmap(rollout))(states)
    recorded = recording["agent"]["voltage"]
    np.testing.assert_allclose(voltages[0, : len(recorded)], recorded, rtol=1e-6)
    corner = (recorded - np.arange(len(recorded))) / 0.5
    np.testing.assert_allclose(voltages[2, : len(recorded)], -corner + np.arange(len(recorded)), rtol=1e-5)


@pytest.mark.parametrize("clock", [px.WALL_CLOCK, px.SIMULATED])
def test_what_a_run_begins_with_can_be_replaced(clock):
    supervisor, nodes = robot.loop(weight=3.0)
    graph = px.Graph(supervisor, nodes, clock=clock)
    state = graph.init()
    state = state.replace(params=state.params | {"agent": {"weight": jnp.asarray(2.0)}})
    state = state.replace(state=state.state | {"agent": {"steps": jnp.asarray(100)}})
    for step in range(10):
        state = graph.run(state)
        assert int(state.state["agent"]["steps"]) == 101 + step
    graph.stop()
    agrees(graph.get_record(), weight=2.0, first=100)
    with pytest.raises(px.ParallaxError, match="init"):
        graph.run(state)


@pytest.mark.parametrize("clock", [px.WALL_CLOCK, px.SIMULATED])
def test_outputs_from_outside_take_the_place_of_the_supervisor(clock):
    supervisor, nodes = robot.loop()
    graph = px.Graph(supervisor, nodes, clock=clock)
    state, seen = graph.reset(graph.init())
    for step in range(10):
        assert int(seen.seq) == step
        message = seen.inputs["cam"]["message"]
        number = seen.inputs["cam"]["seq"][0]
        assert message["place"].position.shape == (1, 2, 3)
        assert message["place"].position[0, 1, 2] == (0.0 if number < 0 else 5.0 + number)
        state, seen = graph.step(state, {"voltage": 10.0 * step})
        assert state.output["voltage"] == 10.0 * step
    graph.stop()
    np.testing.assert_array_equal(graph.get_record()["agent"]["voltage"], 10.0 * np.arange(10))
    # Its own step was never made.
    assert int(state.state["agent"]["steps"]) == 0


@pytest.mark.parametrize("clock", [px.WALL_CLOCK, px.SIMULATED])
def test_a_graph_of_rust_is_stepped_from_python(clock):
    graph = px.Graph("pendulum", clock=clock)
    state, seen = graph.reset(graph.init(seed=1))
    for _ in range(20):
        estimate = seen.inputs["estimator"]["message"]
        state, seen = graph.step(state, {"voltage": 0.1 * float(estimate["speed"][-1])})
    state = graph.run(state)
    graph.stop()
    recording = graph.get_record()
    assert len(recording["agent"].seq) == 21
    assert len(recording["world"].seq) > 50


@pytest.mark.parametrize("clock", [px.WALL_CLOCK, px.SIMULATED])
def test_a_node_that_fails_is_told_with_its_traceback(clock):
    supervisor, nodes = robot.loop(log={"fail_at": 3})
    # Nobody waits for the log, but a run ends with the node that it was to keep.
    graph = px.Graph(supervisor, nodes, clock=clock)
    state = graph.init()
    if clock == px.SIMULATED:
        with pytest.raises(px.ParallaxError, match="the log is full"):
            graph.simulate(graph._session.path, 1.0)
        return
    with pytest.raises(px.ParallaxError, match=r"(?s)log.*the log is full") as told:
        steps(graph, state, 300)
    assert "robot.py" in str(told.value)
    assert len(graph.get_record()["log"].seq) == 3


def test_a_supervisor_that_fails_is_told_with_its_traceback():
    _, nodes = robot.loop()
    log = nodes[2]
    failing = robot.Log(rate=10.0, name="failing", fail_at=2)
    for connection in log.connections:
        failing.connect(connection.sender, window=connection.window)
    graph = px.Graph(failing, [failing, *nodes], clock=px.SIMULATED)
    state = graph.init()
    with pytest.raises(px.ParallaxError, match="the log is full"):
        steps(graph, state, 5)
    graph.stop()
    assert len(graph.get_record()["failing"].seq) == 2


INTERRUPTED = """
import gc, signal, sys
# Programs that a shell starts in the background ignore Ctrl-C, and hand that down: so may these tests.
signal.signal(signal.SIGINT, signal.default_int_handler)
import parallax as px
import robot

if __name__ == "__main__":
    supervisor, nodes = robot.loop()
    graph = px.Graph(supervisor, nodes)
    state = graph.init(recording="run.mcap")
    for step in range(0 if sys.argv[1] == "starting" else 10):
        state = graph.run(state)
    print("begun", flush=True)
    if sys.argv[1] == "collecting":
        gc.callbacks.append(lambda phase, info: signal.raise_signal(signal.SIGINT))
        gc.collect()
        gc.callbacks.pop()
    if sys.argv[1] == "always collecting":
        # Whatever is made starts a collection, and each calls JAX.
        gc.set_threshold(1)
    while True:
        state = graph.run(state)
"""


@pytest.mark.parametrize("when", ["starting", "running", "collecting", "always collecting"])
def test_an_interrupted_run_leaves_a_recording(tmp_path, when):
    script = tmp_path / "script.py"
    script.write_text(INTERRUPTED)
    environment = os.environ | {"PYTHONPATH": str(ROOT / "bindings" / "tests")}
    process = subprocess.Popen(
        [sys.executable, script, when],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n", process.communicate()
        # The one is sent by itself, and falls into a callback of the collector.
        if when != "collecting":
            time.sleep(0.5)
            os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert "KeyboardInterrupt" in errors, errors
    if when != "starting":
        recording = px.load(tmp_path / "run.mcap")
        assert recording.truncated is None
        assert len(recording["agent"].seq) >= 10


def test_recordings_are_views():
    _, recording, _, _ = ran(px.SIMULATED)
    cam, agent = recording["cam"], recording["agent"]
    assert np.shares_memory(cam.tree["place"].position, cam.payload)
    assert np.shares_memory(agent["voltage"], agent.payload)
    pandas, xarray = pytest.importorskip("pandas"), pytest.importorskip("xarray")
    frame = agent.to_pandas()
    assert isinstance(frame, pandas.DataFrame)
    assert np.shares_memory(frame.to_numpy(), agent.payload)
    np.testing.assert_array_equal(frame.index, agent.sent)
    data = agent.to_xarray()
    assert isinstance(data, xarray.Dataset)
    assert np.shares_memory(data["voltage"].to_numpy(), agent.payload)


def wrong(make):
    """What is said about a loop that `make` has changed."""
    supervisor, nodes = robot.loop()
    with pytest.raises((TypeError, ValueError, NotImplementedError, px.ParallaxError)) as told:
        make(supervisor, nodes)
    return str(told.value)


class Complex(px.Node):
    def init_output(self, key, params, state):
        return {"voltage": jnp.asarray(1j)}


def test_what_is_wrong_is_named():
    def graph(supervisor, nodes, **options):
        return px.Graph(supervisor, nodes, **options)

    assert "fed by cam, which is not among" in wrong(lambda agent, nodes: graph(agent, nodes[1:]))
    assert "two nodes are called cam" in wrong(lambda agent, nodes: graph(agent, [*nodes, robot.Cam(rate=1.0)]))
    assert "no rate" in wrong(lambda agent, nodes: graph(agent, [*nodes, robot.Cam(name="other")]))
    assert "0 Hz" in wrong(lambda agent, nodes: robot.Cam(rate=0))
    assert "cannot name a node" in wrong(lambda agent, nodes: robot.Cam(rate=1.0, name="two words"))
    assert "is fed already" in wrong(lambda agent, nodes: agent.connect(nodes[0]))
    assert "one at least" in wrong(lambda agent, nodes: agent.connect(nodes[0], window=0, name="other"))
    assert "complex" in wrong(lambda agent, nodes: graph(agent, [*nodes, Complex(rate=1.0)]))
    assert "needs a method init_output" in wrong(lambda agent, nodes: graph(agent, [*nodes, px.Node(rate=1.0)]))
    assert "runs in real time" in wrong(lambda agent, nodes: graph(agent, nodes, real_time_factor=2.0))
    assert "init() first" in wrong(lambda agent, nodes: graph(agent, nodes).run(None))
    assert "no recording" in wrong(lambda agent, nodes: graph(agent, nodes).get_record())
    assert "step on `cpu:77`" in wrong(lambda agent, nodes: graph(agent, nodes).warmup({"agent": "cpu:77"}))
    assert "not written in JAX" in wrong(lambda agent, nodes: graph(agent, nodes).warmup({"log": "cpu"}))
    assert "is no node" in wrong(lambda agent, nodes: agent.connect("cam"))

    def mismatch(agent, nodes):
        nodes[-1].connect(nodes[0], name="other")
        supervisor = robot.Cam(rate=3.0, name="supervisor")
        motor = px.RustNode("pendulum/motor", rate=50.0)
        motor.connect(supervisor, name="agent")
        return graph(supervisor, [supervisor, motor])

    assert "node motor takes" in wrong(mismatch)

    class Local(px.Node):
        def init_output(self, key, params, state):
            return {"x": jnp.asarray(0.0)}

        def step(self, params, state, step):
            return state, {"x": jnp.asarray(1.0)}

    def homeless(agent, nodes):
        made = graph(agent, [*nodes, Local(rate=10.0)])
        made.run(made.init())

    assert "inside a function" in wrong(homeless)
    # Under the simulated clock it runs: no other process has to find it.
    supervisor, nodes = robot.loop()
    made = px.Graph(supervisor, [*nodes, Local(rate=10.0)], clock=px.SIMULATED)
    made.run(made.init())
    made.stop()


def test_the_example_does_all_three():
    command = [sys.executable, ROOT / "examples/python/figure3.py", "--steps", "30"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "angles (1000," in done.stdout, done.stdout
