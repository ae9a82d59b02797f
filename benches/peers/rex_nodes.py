"""The graph world -> sensor -> agent -> motor -> world in rex-lib's terms, with the equations that all peers share."""

import jax
import jax.numpy as jnp
import rex.base
from distrax import Normal
from flax import struct
from rex.node import BaseNode

import common
import models


@struct.dataclass
class Values(rex.base.Base):
    """A message or a state: named numbers."""

    values: dict[str, jax.Array]


@struct.dataclass
class Constants(rex.base.Base):
    """Parameters: named numbers."""

    values: dict[str, jax.Array]


@struct.dataclass
class Nothing(rex.base.Base):
    """No state and no parameters."""


class Numbers:
    """Numbers of one width, as rex-lib's nodes start with them."""

    def __init__(self, number):
        self.number = number

    def __call__(self, values):
        return Values({k: jnp.asarray(v, self.number) for k, v in values.items()})


class World(BaseNode):
    """The equations, integrated from step to step."""

    def __init__(self, *args, model, numbers, **kwargs):
        super().__init__(*args, **kwargs)
        self.model, self.numbers = model, numbers

    def init_params(self, rng=None, graph_state=None):
        return Constants(self.numbers(self.model.nominal).values)

    def init_state(self, rng=None, graph_state=None):
        return self.numbers(self.model.start)

    def init_output(self, rng=None, graph_state=None):
        return self.numbers(self.model.start)

    def step(self, step_state):
        u = step_state.inputs["motor"][-1].data.values
        dt = self.numbers.number(common.STEP)
        x = models.rk4(self.model.derivative, step_state.params.values, step_state.state.values, u, dt)
        return step_state.replace(state=Values(x)), Values(x)


class Pass(BaseNode):
    """A sensor or a motor's driver: passes the newest message on."""

    def __init__(self, *args, source, first, numbers, **kwargs):
        super().__init__(*args, **kwargs)
        self.source, self.first, self.numbers = source, first, numbers

    def init_output(self, rng=None, graph_state=None):
        return self.numbers(self.first)

    def step(self, step_state):
        return step_state, Values(step_state.inputs[self.source][-1].data.values)


class Agent(BaseNode):
    """Sends the action that was drawn beforehand for its step. Its input is read and not used."""

    def __init__(self, *args, first, numbers, **kwargs):
        super().__init__(*args, **kwargs)
        self.first, self.numbers = first, numbers

    def init_params(self, rng=None, graph_state=None):
        table = {k: jnp.zeros(common.STEPS + 2, self.numbers.number) for k in self.first}
        return Constants(table)

    def init_output(self, rng=None, graph_state=None):
        return self.numbers(self.first)

    def step(self, step_state):
        seq = step_state.seq
        action = {k: table[seq] for k, table in step_state.params.values.items()}
        return step_state, Values(action)


def nodes(model, number):
    """The four nodes, connected; rates and delays are those of the other peers."""
    numbers = Numbers(number)
    first = dict.fromkeys(model.bounds, 0.0)
    normal = lambda delay: Normal(loc=delay[0], scale=delay[1])
    world = World(name="world", rate=1 / common.STEP, model=model, numbers=numbers)
    sensor = Pass(
        name="sensor",
        rate=common.RATE,
        delay_dist=normal(common.SENSOR),
        source="world",
        first=model.start,
        numbers=numbers,
    )
    agent = Agent(name="agent", rate=common.RATE, delay_dist=normal(common.AGENT), first=first, numbers=numbers)
    motor = Pass(
        name="motor",
        rate=common.RATE,
        delay_dist=normal(common.MOTOR),
        source="agent",
        first=first,
        numbers=numbers,
    )
    sensor.connect(world, window=1, blocking=False)
    agent.connect(sensor, window=1, blocking=False, delay_dist=normal(common.WIRE))
    motor.connect(agent, window=1, blocking=False, delay_dist=normal(common.WIRE))
    world.connect(motor, window=1, blocking=False, skip=True, delay_dist=normal(common.WIRE))
    return {"world": world, "sensor": sensor, "agent": agent, "motor": motor}
