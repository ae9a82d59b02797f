"""Programs as JAX functions: the values and derivatives that Rust computes, under every transformation."""

from __future__ import annotations

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import parallax as px

UNARY = ["neg", "sin", "cos", "tan", "asin", "acos", "atan", "exp", "ln", "sqrt", "tanh", "abs", "sign", "floor"]
BINARY = ["add", "sub", "mul", "div", "atan2", "powf"]


def program(ops, outputs, inputs=2, functions=()):
    """A program of two inputs from its operations."""
    body = {"name": "test", "inputs": inputs, "ops": ops, "outputs": outputs}
    content = {
        "inputs": [f"x{i}" for i in range(inputs)],
        "outputs": [f"y{i}" for i in range(len(outputs))],
        "functions": [*functions, body],
    }
    return px.Program.from_json(json.dumps(content))


OPERATIONS = (
    {name: program([{"unary": [name, 0]}], [2]) for name in UNARY}
    | {name: program([{"binary": [name, 0, 1]}], [2]) for name in BINARY}
    | {f"powi {n}": program([{"powi": [0, n]}], [2]) for n in (-2, 0, 1, 3, 7)}
    | {name: program([{"compare": [name, 0, 1]}, {"select": [2, 0, 1]}], [3]) for name in ("lt", "le", "eq")}
    | {
        "masks": program(
            [
                {"constant": 0.0},
                {"compare": ["lt", 0, 2]},
                {"compare": ["le", 1, 2]},
                {"and": [3, 4]},
                {"or": [3, 4]},
                {"not": 5},
                {"select": [5, 0, 1]},
                {"select": [6, 0, 1]},
                {"select": [7, 0, 1]},
            ],
            [8, 9, 10],
        )
    }
)

# Outside of it the operation has no value, or not this one to the last bits.
DOMAIN = {"asin": (-1, 1), "acos": (-1, 1), "ln": (1e-6, 50), "sqrt": (0, 50), "powf": (1e-3, 5), "tan": (-1.4, 1.4)}


def close(ours, theirs, tolerance=1e-12):
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    np.testing.assert_array_less(np.abs(ours - theirs), tolerance * (1 + np.abs(theirs)) + 1e-300)


@pytest.mark.parametrize("name", OPERATIONS)
def test_operations_have_the_values_of_rust(name, x64):
    operation = OPERATIONS[name]
    low, high = DOMAIN.get(name, (-5, 5))
    inputs = np.random.default_rng(3).uniform(low, high, (500, 2))
    inputs[:5] = inputs[:5, :1]  # equal numbers
    ours = np.stack(operation(*map(jnp.asarray, inputs.T)), axis=-1)
    close(ours, operation.evaluate(inputs))


@pytest.mark.parametrize("name", OPERATIONS)
def test_operations_have_the_derivatives_of_rust(name, x64):
    operation = OPERATIONS[name]
    low, high = DOMAIN.get(name, (-5, 5))
    inputs = np.random.default_rng(4).uniform(low, high, (20, 2))
    for derivative in (jax.jacrev, jax.jacfwd):
        ours = jax.vmap(derivative(lambda x: jnp.stack(operation(x[0], x[1]))))(inputs)
        for row, point in zip(ours, inputs, strict=True):
            close(row, operation.jacobian(point, [0, 1]), 1e-11)


@pytest.mark.parametrize("name", ["sqrt", "abs", "sign", "floor", "asin", "acos", "atan2", "powf", "powi 1", "tanh"])
def test_single_points_have_the_values_and_derivatives_of_rust(name, x64):
    operation = OPERATIONS[name]
    for point in ([0.0, 0.0], [-0.0, 2.0], [1.0, 1.0], [0.0, 1.0], [-1.0, 3.0]):
        theirs = operation.evaluate(np.array([point]))[0]
        if not np.all(np.isfinite(theirs)):
            continue
        close(np.stack(operation(*map(jnp.asarray, point))), theirs)
        slopes = operation.jacobian(point, [0, 1])
        ours = jax.jacrev(lambda x: jnp.stack(operation(x[0], x[1])))(jnp.asarray(point))
        if np.all(np.isfinite(slopes)):
            close(ours, slopes, 1e-11)


def test_a_branch_that_is_not_taken_does_not_spoil_gradients(x64):
    # select(x <= 0, 0, f(x)) at points where f or its derivative is infinite or no number.
    for risky in ({"unary": ["sqrt", 0]}, {"unary": ["ln", 0]}, {"binary": ["div", 1, 0]}, {"binary": ["powf", 0, 1]}):
        chosen = program([{"constant": 0.0}, {"compare": ["le", 0, 2]}, risky, {"select": [3, 2, 4]}], [5])
        for x in (0.0, -1.0):
            gradient = jax.grad(lambda p, chosen=chosen: chosen(p[0], p[1])[0])(jnp.asarray([x, 0.5]))
            assert np.all(gradient == 0), (risky, x, gradient)


def test_loops_and_calls(x64):
    # A scan that integrates x' = -c x + u for 40 steps and keeps every x; a map that squares them; then a call.
    step = {
        "name": "step",
        "inputs": 3,
        "ops": [
            {"constant": 0.1},
            {"binary": ["mul", 0, 2]},
            {"binary": ["sub", 1, 4]},
            {"binary": ["mul", 3, 5]},
            {"binary": ["add", 0, 6]},
        ],
        "outputs": [7, 7],
    }
    square = {
        "name": "square",
        "inputs": 2,
        "ops": [{"binary": ["mul", 0, 0]}, {"binary": ["mul", 2, 1]}],
        "outputs": [3],
    }
    for length in (0, 3, 90):
        ops = [
            {"scan": {"function": 0, "length": length, "carry": [0], "xs": [1] * length, "captures": [1]}},
            {"map": {"function": 1, "length": length, "xs": list(range(3, 3 + length)), "captures": [0]}},
            {"call": {"function": 1, "inputs": [2, 1]}},
        ]
        last = 3 + 2 * length
        loops = program(ops, [2, last, *range(3 + length, last)], functions=(step, square))
        inputs = np.random.default_rng(5).normal(size=(4, 2))
        close(np.stack(loops(*map(jnp.asarray, inputs.T)), -1), loops.evaluate(inputs), 1e-11)
        ours = jax.jacrev(lambda x, loops=loops: jnp.stack(loops(x[0], x[1])))(inputs[0])
        close(ours, loops.jacobian(inputs[0], [0, 1]), 1e-10)


def test_single_precision_stays_single():
    mixed = program([{"constant": 0.1}, {"binary": ["mul", 0, 2]}, {"unary": ["exp", 3]}], [4])
    assert mixed(jnp.float32(1.0), 2.0)[0].dtype == jnp.float32
    assert mixed(1.0, 2.0)[0] == math.exp(0.1)  # known numbers are folded in double precision


def test_what_is_not_needed_is_not_read():
    half = program([{"unary": ["sin", 0]}, {"unary": ["cos", 1]}], [2, 3])
    assert half.needed == {0, 1}
    assert half.needed_for([0]) == {0}


def test_a_wrong_program_is_an_error():
    with pytest.raises(px.ParallaxError, match="not defined"):
        program([{"unary": ["sin", 9]}], [2])
    with pytest.raises(px.ParallaxError, match="not a program"):
        px.Program.from_json("{")
    sine = program([{"unary": ["sin", 0]}], [2])
    with pytest.raises(TypeError, match="called with 1 inputs"):
        sine(1.0)
    with pytest.raises(px.ParallaxError, match="takes 2 inputs"):
        sine.evaluate(np.zeros((1, 3)))
    with pytest.raises(px.ParallaxError, match="no input 7"):
        sine.jacobian([0.0, 0.0], [7])


@pytest.mark.parametrize("name", ["pendulum", "quadrotor"])
def test_models_are_step_functions(name, x64):
    model = px.models()[name]
    random = np.random.default_rng(6)
    count = len(model.program.inputs) - len(model.nominal)
    inputs = np.concatenate([np.tile(model.nominal, (50, 1)), 0.1 * random.normal(size=(50, count))], axis=1)
    inputs[:, -1] = 0.01
    ours = np.stack(jax.jit(model.program)(*map(jnp.asarray, inputs.T)), axis=-1)
    close(ours, model.program.evaluate(inputs))
    ours = jax.jacrev(lambda x: jnp.stack(model.program(*x)))(inputs[0])
    close(ours, model.program.jacobian(inputs[0], range(inputs.shape[1])))


def test_a_model_simulates(x64):
    pendulum = px.models()["pendulum"]

    def energy(voltage):
        def step(state, _):
            return pendulum.step(pendulum.params(), state, {"voltage": voltage}, 0.01)

        start = {"angle": jnp.asarray(math.pi), "speed": jnp.asarray(0.0)}
        last, seen = jax.lax.scan(step, start, length=100)
        return last["speed"] ** 2, seen["angle"]

    (value, seen), slope = jax.value_and_grad(energy, has_aux=True)(1.0)
    assert seen.shape == (100,)
    difference = (energy(1.0 + 1e-6)[0] - energy(1.0 - 1e-6)[0]) / 2e-6
    assert value > 0
    assert abs(slope - difference) < 1e-5 * (1 + abs(difference))


def test_a_system_is_a_model(tmp_path, x64):
    path = tmp_path / "system.toml"
    path.write_text(
        """format = 1
name = "spring"
[parameters]
k = { value = 4.0, unit = "N/m", calibrate = [1, 9] }
m = { value = 1.0, unit = "kg" }
[inputs]
force = { signal = "force" }
[state]
x = { derivative = "v", initial = 1.0 }
v = { derivative = "(force - k*x)/m" }
[outputs]
position = { value = "x", unit = "m" }
""",
        encoding="utf-8",
    )
    system = px.System(path)
    assert system.states == ["x", "v"]
    assert system.parameters["k"].calibrate == (1, 9)
    state, params = system.initial(), system.params()
    assert system.derivative(params, state, {"force": 1.0}) == {"x": 0.0, "v": -3.0}

    def simulate(state):
        def step(state, _):
            return system.step(params, state, {"force": 0.0}, 0.01), None

        return jax.lax.scan(step, state, length=100)[0]

    last = jax.jit(simulate)(state)
    close(last["x"], math.cos(2.0), 1e-8)
    assert system.output(params, last, {"force": 0.0})["position"] == last["x"]
    with pytest.raises(px.ParallaxError, match="does not exist"):
        px.System(tmp_path / "absent.toml")
    path.write_text(path.read_text().replace("k*x", "k*y"), encoding="utf-8")
    with pytest.raises(px.ParallaxError, match=r"system.toml:.*y|`y`"):
        px.System(path)


CORRECTED = """format = 1
name = "cart"
[parameters]
k = { value = 4.0, unit = "N/m" }
m = { value = 1.5, unit = "kg" }
[inputs]
force = { signal = "force" }
[state]
x = { derivative = "v", initial = 1.0 }
v = { derivative = "(force - k*x)/m", initial = 0.0 }
[outputs]
position = { value = "x", unit = "m" }
[joints]
rail = { position = "x", velocity = "v", inertia = "m", drive = "force" }
[[effect]]
name = "saturation"
place = "input:force"
parameters = { low = -1.0, high = 2.0 }
[[effect]]
name = "lag"
place = "input:force"
parameters = { time_constant = 0.05 }
[[effect]]
name = "coulomb"
place = "joint:rail"
parameters = { force = 0.7 }
smoothing = 0.1
[[effect]]
name = "bias"
place = "output:position"
parameters = { bias = 0.25 }
"""


def test_a_corrected_system_has_its_effects(tmp_path, x64):
    path = tmp_path / "system.corrected.toml"
    path.write_text(CORRECTED, encoding="utf-8")
    system, dt = px.System(path), 0.02
    commands = [3.0 * math.sin(0.11 * i) for i in range(300)]

    def simulate(params, lag):
        def step(state, force):
            inputs = {"force": force}
            return system.step(params, state, inputs, dt), system.output(params, state, inputs)["position"]

        state = system.initial({"force": commands[0]}) | lag
        return jax.lax.scan(step, state, jax.numpy.asarray(commands))[1]

    shown = jax.jit(simulate)(system.params(), {})

    # The same by hand: the lag solved exactly over each half of a tick, one step of Runge and Kutta over each.
    x, v, lagged, tau, half = 1.0, 0.0, commands[0], 0.05 + 1e-9, dt / 2
    for i, command in enumerate(commands):
        close(shown[i], x + 0.25, 1e-12)
        command = min(max(command, -1.0), 2.0)
        for _ in range(2):
            decay = math.exp(-half / tau)
            mean = command + (lagged - command) * tau / half * (1 - decay)
            lagged = command + (lagged - command) * decay

            def rate(x, v, mean=mean):
                return v, (mean - 0.7 * math.tanh(v / 0.1) - 4.0 * x) / 1.5

            a = rate(x, v)
            b = rate(x + half / 2 * a[0], v + half / 2 * a[1])
            c = rate(x + half / 2 * b[0], v + half / 2 * b[1])
            d = rate(x + half * c[0], v + half * c[1])
            x += half / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
            v += half / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])

    slopes = jax.grad(lambda params, lag: simulate(params, lag)[-1], argnums=(0, 1))(
        system.params(), system.initial({"force": 0.0})
    )
    leaves = jax.tree.leaves(slopes)
    assert all(math.isfinite(leaf) for leaf in leaves)
    assert any(leaf != 0 for leaf in leaves)


def test_an_effect_that_cannot_act_is_named(tmp_path):
    path = tmp_path / "system.toml"
    delay = CORRECTED.replace('"saturation"', '"delay"').replace("{ low = -1.0, high = 2.0 }", "{ delay = 0.1 }")
    unsmoothed = CORRECTED.replace("smoothing = 0.1\n", "")
    for text, reason in [(delay, "delay.*input:force.*connection"), (unsmoothed, "coulomb.*joint:rail.*smoothing")]:
        path.write_text(text, encoding="utf-8")
        with pytest.raises(px.ParallaxError, match=reason):
            px.System(path)
