"""MuJoCo: the pendulum as a hinge with a motor, Runge-Kutta of fourth order at 100 Hz, one run after the other.

The torque is the voltage times K/R, the joint's damping is b + K^2/R, its Coulomb friction is c; contacts are off.
The model is that of appendix C; MuJoCo solves for the friction as a constraint, which is more work than a sign is.
The same model without friction is reported, too: the least that MuJoCo can do.

- `rollout`: mujoco.rollout, which takes the drawn actions and stays in C.
"""

import common

chosen = common.options(dtypes="f64")

import mujoco
import numpy as np
from mujoco import rollout

P = {  # nodes/src/models/pendulum.rs
    "inertia": 1.6e-4,
    "mass": 0.0509,
    "length": 0.0415,
    "damping": 1.43e-5,
    "motor": 0.0333,
    "resistance": 7.73,
    "friction": 9.75e-4,
}


def text(p, friction):
    """The model in MJCF. The hinge's inertia about the shaft is J: what the point mass leaves of it is armature."""
    drag = p["damping"] + p["motor"] ** 2 / p["resistance"]
    armature = p["inertia"] - p["mass"] * p["length"] ** 2
    return f"""
<mujoco>
  <compiler inertiafromgeom="false"/>
  <option timestep="{common.STEP}" integrator="RK4" gravity="0 0 -9.81">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body>
      <joint name="shaft" type="hinge" axis="0 1 0" damping="{drag}" armature="{armature - 1e-9}"
             frictionloss="{p["friction"] if friction else 0}"/>
      <inertial pos="0 0 -{p["length"]}" mass="{p["mass"]}" diaginertia="1e-9 1e-9 1e-9"/>
    </body>
  </worldbody>
  <actuator><motor joint="shaft" gear="{p["motor"] / p["resistance"]}"/></actuator>
</mujoco>"""


def main():
    peer = f"MuJoCo {mujoco.__version__}"
    envs = min(16, max(chosen.envs))  # one after the other: more of them tell nothing
    rng = np.random.default_rng(1)
    several = [{k: v * rng.uniform(0.95, 1.05) for k, v in P.items()} for _ in range(envs)]
    held = np.repeat(np.random.default_rng(2).uniform(-2.0, 2.0, (envs, common.STEPS, 1)), 2, axis=1)
    for friction in [True, False]:
        built = [mujoco.MjModel.from_xml_string(text(p, friction)) for p in several]
        datum = mujoco.MjData(built[0])
        full = mujoco.mjtState.mjSTATE_FULLPHYSICS
        first = np.zeros((envs, mujoco.mj_stateSize(built[0], full)))
        for n in sorted({1, envs}):
            states = np.zeros((n, 2 * common.STEPS, first.shape[1]))

            def run():
                rollout.rollout(built[:n], datum, first[:n], held[:n], state=states)

            seconds = common.measure(run, chosen)
            way = "rollout" if friction else "rollout, without Coulomb friction"
            common.throughput(peer, "pendulum, bare", "f64", n, common.STEPS, seconds, way=way)


main()
