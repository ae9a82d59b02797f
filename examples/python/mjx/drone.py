"""A drone in MuJoCo that flies to and fro, as the log that a flight leaves: commands, pose and angular speed.

Its own model does not know that the air drags at it (or, with `--hide delay`, that its thrust comes late).

python examples/python/mjx/drone.py --out out/flight
parallax new system --mjcf examples/python/mjx/drone.xml --out out/drone.toml \
    --output drone=position:drone --output gyro=sensor:gyro
parallax diagnose --system out/drone.toml out/flight --out out/drone
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mujoco
import numpy as np

MODEL = Path(__file__).resolve().parent / "drone.xml"
RATE = 50
"""Commands and readings a second."""
COMMANDS = {"thrust": "N", "roll": "N m", "pitch": "N m", "yaw": "N m"}
READINGS = dict.fromkeys(("drone_0", "drone_1", "drone_2"), "m") | {
    **dict.fromkeys(("drone_3", "drone_4", "drone_5", "drone_6"), ""),
    **dict.fromkeys(("gyro_0", "gyro_1", "gyro_2"), ""),
}
"""Units of the readings: place, rotation as a quaternion, and angular speed."""


def course(t: float) -> np.ndarray:
    """Where it is to be, m: 1.5 m to and fro along x, little along the others."""
    return np.array([1.5 * np.sin(1.9 * t), 0.15 * np.sin(1.3 * t), 1.0 + 0.25 * np.sin(2.6 * t)])


def controlled(model: mujoco.MjModel, data: mujoco.MjData, t: float) -> np.ndarray:
    """Thrust and torques that follow the course, with some sines that shake it."""
    pull = 6.0 * (course(t) - data.qpos[:3]) - 3.5 * data.qvel[:3] + [0.0, 0.0, 9.81]
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, data.qpos[3:7])
    turn = turn.reshape(3, 3)
    up = turn.T @ (pull / np.linalg.norm(pull))
    tilt = np.cross([0.0, 0.0, 1.0], up)
    tilt[2] = -turn[1, 0]
    shake = 0.01 * np.sin(2 * np.pi * np.array([3.1, 2.3, 1.7]) * t)
    torque = model.body_inertia[1] * (120.0 * tilt - 18.0 * data.qvel[3:6]) + shake * [
        1,
        1,
        0.3,
    ]
    thrust = model.body_mass[1] * float(turn[:, 2] @ pull) * (1.0 + 0.05 * np.sin(2 * np.pi * 3.7 * t))
    return np.array([thrust, *torque])


def fly(seconds: float, drag: float, delay: float) -> np.ndarray:
    """A flight: time, commands and readings in rows. `drag` in N s²/m², `delay` in s."""
    model = mujoco.MjModel.from_xml_path(str(MODEL))
    data = mujoco.MjData(model)
    draw = np.random.default_rng(1)
    every = round(1.0 / (RATE * model.opt.timestep))
    late = round(delay / model.opt.timestep)
    thrusts = [float(model.body_mass[1] * 9.81)] * (late + 1)
    command, rows = np.zeros(4), []
    for step in range(round(seconds * RATE) * every):
        if step % every == 0:
            mujoco.mj_forward(model, data)
            command = controlled(model, data, data.time)
            noise = np.repeat([3e-4, 5e-4, 2e-3], [3, 4, 3]) * draw.normal(size=10)
            rows.append(
                [
                    step / every / RATE,
                    *command,
                    *(np.r_[data.qpos, data.sensor("gyro").data] + noise),
                ]
            )
        thrusts.append(command[0])
        data.ctrl = [thrusts[-1 - late], *command[1:]]
        data.qfrc_applied[:3] = -drag * np.abs(data.qvel[:3]) * data.qvel[:3]
        mujoco.mj_step(model, data)
    return np.array(rows)


def main() -> None:
    """Writes the flight as a folder with a recording.toml."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/flight"),
        help="the folder to write (default: out/flight)",
    )
    parser.add_argument("--duration", type=float, default=10.0, help="seconds (default: 10)")
    parser.add_argument(
        "--hide",
        choices=["drag", "delay", "nothing"],
        default="drag",
        help="(default: drag)",
    )
    arguments = parser.parse_args()
    drag, delay = 0.08 * (arguments.hide == "drag"), 0.03 * (arguments.hide == "delay")
    rows = fly(arguments.duration, drag, delay)
    arguments.out.mkdir(parents=True, exist_ok=True)
    units = COMMANDS | READINGS
    np.savetxt(
        arguments.out / "log.csv",
        rows,
        "%.9g",
        ",",
        header=",".join(["t", *units]),
        comments="",
    )
    lines = ["format = 1", 'title = "a flight of a drone"']
    for name, unit in units.items():
        role = "command" if name in COMMANDS else "measurement"
        lines += [
            "",
            "[[signal]]",
            f'name = "{name}"',
            f'role = "{role}"',
            f'unit = "{unit}"',
        ]
        lines += ['file = "log.csv"', 'time = "t"', f'value = "{name}"']
    (arguments.out / "recording.toml").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
