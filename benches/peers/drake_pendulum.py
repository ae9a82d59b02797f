"""Drake: the pendulum in a diagram, with fixed steps, one run after the other.

Drake has no Runge-Kutta method of fourth order with fixed steps: its third order is taken, which evaluates the
equations three times a step instead of four. The equations are written in two ways, the actions come in two; all four
are reported.

- `expressions`: a SymbolicVectorSystem of the very equations.
- `plant`: Drake's PendulumPlant, whose torque is the voltage times K/R and whose damping is b + K^2/R. It has no
  Coulomb friction: less work than the other peers do.
- `drawn`: the drawn actions, held for a supervisor step each, as a TrajectorySource.
- `source`: a RandomSource that draws an action every supervisor step: cheaper than looking a drawn one up.
"""

import common

chosen = common.options(envs="1", dtypes="f64")

from importlib.metadata import version

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.examples import PendulumParams, PendulumPlant
from pydrake.symbolic import Variable, if_then_else, sin
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Gain, RandomSource, SymbolicVectorSystem, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

GRAVITY = 9.81
P = {  # nodes/src/models/pendulum.rs
    "inertia": 1.6e-4,
    "mass": 0.0509,
    "length": 0.0415,
    "damping": 1.43e-5,
    "motor": 0.0333,
    "resistance": 7.73,
    "friction": 9.75e-4,
}


def expressions(builder):
    """Appendix C."""
    angle, speed, voltage = Variable("angle"), Variable("speed"), Variable("voltage")
    sign = if_then_else(speed > 0, 1.0, if_then_else(speed < 0, -1.0, 0.0))
    drag = P["damping"] + P["motor"] ** 2 / P["resistance"]
    torque = (
        voltage * (P["motor"] / P["resistance"])
        + P["mass"] * P["length"] * GRAVITY * sin(angle)
        - speed * drag
        - P["friction"] * sign
    )
    system = SymbolicVectorSystem(
        state=[angle, speed], input=[voltage], dynamics=[speed, torque / P["inertia"]], output=[angle, speed]
    )
    added = builder.AddSystem(system)
    return added.get_input_port(), lambda context: context.SetContinuousState([np.pi, 0.0])


def plant(builder):
    """PendulumPlant: its inertia is m l^2, so that all torques are scaled to the inertia of appendix C."""
    gain = builder.AddSystem(Gain(P["motor"] / P["resistance"], 1))
    added = builder.AddSystem(PendulumPlant())
    builder.Connect(gain.get_output_port(), added.get_input_port())

    def start(context):
        own = added.GetMyMutableContextFromRoot(context)
        constants: PendulumParams = added.get_mutable_parameters(own)
        # m l^2 = J and m g l as given.
        constants.set_mass((P["mass"] * P["length"]) ** 2 / P["inertia"])
        constants.set_length(P["inertia"] / (P["mass"] * P["length"]))
        constants.set_damping(P["damping"] + P["motor"] ** 2 / P["resistance"])
        constants.set_gravity(GRAVITY)
        context.SetContinuousState([0.0, 0.0])

    return gain.get_input_port(), start


def drawn(builder):
    times = np.arange(common.STEPS + 1) / common.RATE
    values = np.random.default_rng(2).uniform(-2.0, 2.0, (1, common.STEPS + 1))
    return builder.AddSystem(TrajectorySource(PiecewisePolynomial.ZeroOrderHold(times, values)))


def source(builder):
    return builder.AddSystem(RandomSource(RandomDistribution.kUniform, 1, 1 / common.RATE))


def main():
    peer = f"Drake {version('drake')}"
    for equations in [expressions, plant]:
        for actions in [drawn, source]:
            builder = DiagramBuilder()
            port, start = equations(builder)
            builder.Connect(actions(builder).get_output_port(), port)
            simulator = Simulator(builder.Build())
            integrator = ResetIntegratorFromFlags(simulator, "runge_kutta3", common.STEP)
            integrator.set_fixed_step_mode(True)

            def run():
                context = simulator.get_mutable_context()
                context.SetTime(0.0)
                start(context)
                simulator.Initialize()
                simulator.AdvanceTo(common.SECONDS)

            seconds = common.measure(run, chosen)
            way = f"{equations.__name__}, {actions.__name__}"
            common.throughput(peer, "pendulum, bare", "f64", 1, common.STEPS, seconds, way=way)


main()
