"""The joints of a model of MuJoCo as states of a system, and the freedoms in which forces may act.

In MuJoCo's frames (its documentation, "Overview", section "Floating objects"): the velocity of a free joint is that of
its body's origin in the world's frame and the angular velocity in the body's own, and a rotation is the quaternion `q`
from the body's frame to the world's, scalar first, which changes by `½ q ⊗ ω`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..types import Tree

__all__ = ["DIRECTIONS", "Freedom", "Freedoms", "feels_speed", "floats", "rotation", "row", "turned"]

DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
"""What the numbers of a force and a torque are called."""
_QUATERNION = ("qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class Freedom:
    """One freedom of a joint."""

    name: str
    """What the place is called: the joint's name, with `_x`, `_y`, `_z` (in the world's frame) and `_rx`, `_ry`, `_rz`
    (about the body's own axes) where the joint has several."""
    position: str
    """Its position, as an expression of states. About an axis of the body it is the twist, rad: the part of the
    rotation that is about this axis."""
    turns: bool
    """Whether it is an angle, rad, or a distance, m."""

    @property
    def velocity(self) -> str:
        """The state that is its velocity."""
        return f"v_{self.name}"


class Freedoms:
    """All joints of a model, in MuJoCo's order: `qpos` by states, `qvel` by freedoms."""

    def __init__(self, mujoco: Any, mj: Any, joints: Sequence[str]) -> None:
        """`joints` are the names of the model's joints."""
        self.positions: list[str] = []
        """The state of every number of `qpos`."""
        self.all: list[Freedom] = []
        """The freedom of every number of `qvel`."""
        self.quaternions: list[tuple[int, int]] = []
        """Where quaternions begin in `qpos`, and their angular velocities in `qvel`."""
        self.of_joint: list[range] = []
        """The numbers of `qvel` that are each joint's."""
        self.start = [float(value) for value in mj.qpos0]
        """Where the model starts: `qpos`."""
        kinds = mujoco.mjtJoint
        for number, joint in enumerate(joints):
            kind, first = kinds(int(mj.jnt_type[number])), len(self.all)
            if kind in (kinds.mjJNT_FREE, kinds.mjJNT_BALL):
                places = DIRECTIONS[:3] if kind == kinds.mjJNT_FREE else ()
                self.quaternions.append((len(self.positions) + len(places), first + len(places)))
                self.positions += [f"q_{joint}_{word}" for word in (*places, *_QUATERNION)]
                self.all += [Freedom(f"{joint}_{word}", f"q_{joint}_{word}", False) for word in places]
                self.all += [
                    Freedom(f"{joint}_{word}", f"2*atan2(q_{joint}_{axis}, q_{joint}_qw)", True)
                    for word, axis in zip(DIRECTIONS[3:], _QUATERNION[1:], strict=True)
                ]
            else:
                self.positions.append(f"q_{joint}")
                self.all.append(Freedom(joint, f"q_{joint}", bool(kind == kinds.mjJNT_HINGE)))
            self.of_joint.append(range(first, len(self.all)))
        double = sorted({one.name for one in self.all if sum(one.name == other.name for other in self.all) > 1})
        if double:
            raise ValueError(f"the freedoms {double} of the model's joints are called alike; rename the joints")

    def is_quaternion(self, place: int) -> bool:
        """Whether this number of `qpos` is one of a quaternion."""
        return any(first <= place < first + 4 for first, _ in self.quaternions)

    def qpos(self, x: Tree) -> list[Any]:
        """MuJoCo's positions at these states."""
        return [x[one] for one in self.positions]

    def qvel(self, x: Tree) -> list[Any]:
        """MuJoCo's velocities at these states."""
        return [x[one.velocity] for one in self.all]

    def rates(self, x: Tree) -> Tree:
        """How fast positions change."""
        rates: Tree = {}
        for first, about in self.quaternions:
            w, *axis = (x[one] for one in self.positions[first : first + 4])
            speed = [x[one.velocity] for one in self.all[about : about + 3]]
            across = jnp.cross(row(axis), row(speed))
            rates[self.positions[first]] = -0.5 * sum(a * s for a, s in zip(axis, speed, strict=True))
            for at in range(3):
                rates[self.positions[first + 1 + at]] = 0.5 * (w * speed[at] + across[at])
        plain = [place for place in range(len(self.positions)) if not self.is_quaternion(place)]
        turning = {first + at for _, first in self.quaternions for at in range(3)}
        moving = [number for number in range(len(self.all)) if number not in turning]
        return rates | {
            self.positions[place]: x[self.all[number].velocity] for place, number in zip(plain, moving, strict=True)
        }


def row(values: Sequence[Any]) -> Any:
    """These numbers as one array, which may be empty."""
    return jnp.stack([jnp.asarray(value) for value in values]) if values else jnp.zeros(0)


def rotation(quaternion: Sequence[Any]) -> Any:
    """The matrix of a rotation, from the body's frame to the world's: [3, 3]. The quaternion may be of any length."""
    w, x, y, z = quaternion
    scale = 2.0 / (w * w + x * x + y * y + z * z)
    return jnp.stack(
        [
            row([1.0 - scale * (y * y + z * z), scale * (x * y - w * z), scale * (x * z + w * y)]),
            row([scale * (x * y + w * z), 1.0 - scale * (x * x + z * z), scale * (y * z - w * x)]),
            row([scale * (x * z - w * y), scale * (y * z + w * x), 1.0 - scale * (x * x + y * y)]),
        ]
    )


def turned(matrix: Any, values: Any) -> Any:
    """The first three of these generalised forces or accelerations in another frame, the others as they are."""
    return jnp.concatenate([matrix @ values[:3], values[3:]])


def floats(mujoco: Any, mj: Any) -> bool:
    """Whether the model is one body that floats, with what hangs on it, and nothing from the world acts but gravity.

    Where and how it lies then changes nothing but the directions of what comes out, so that it is computed in its own
    frame, where a fifth to a third of the formulas is left.
    """
    if not mj.njnt or mujoco.mjtJoint(int(mj.jnt_type[0])) != mujoco.mjtJoint.mjJNT_FREE:
        return False
    root = mj.jnt_bodyid[0]
    fixed = mj.body_weldid == 0
    own_tree = bool(np.all((mj.body_rootid == root) | fixed))
    free_of_springs = mj.jnt_stiffness[0] == 0 and not mj.dof_armature[:6].any()
    still = not mj.body_gravcomp.any() and not mj.opt.density and not mj.opt.viscosity
    return own_tree and bool(free_of_springs) and still and _drives_itself(mujoco, mj, fixed)


def feels_speed(mj: Any) -> bool:
    """Whether a floating model's speed along the world's axes makes a force: by a damper, or in an actuator."""
    return bool(mj.dof_damping[:3].any() or mj.actuator_biasprm[:, 2].any() or mj.actuator_gainprm[:, 2].any())


def _drives_itself(mujoco: Any, mj: Any, fixed: Any) -> bool:
    """Whether tendons and actuators act between parts of the machine, none of them fixed in the world."""
    kinds, wraps = mujoco.mjtTrn, mujoco.mjtWrap
    if any(wraps(int(kind)) != wraps.mjWRAP_JOINT for kind in mj.wrap_type) or 0 in mj.wrap_objid[: mj.nwrap]:
        return False
    for number in range(mj.nu):
        kind, (target, other) = kinds(int(mj.actuator_trntype[number])), mj.actuator_trnid[number]
        if kind in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
            alone = target != 0
        elif kind == kinds.mjTRN_SITE:
            alone = not fixed[mj.site_bodyid[target]] and (other < 0 or not fixed[mj.site_bodyid[other]])
        else:
            alone = kind == kinds.mjTRN_TENDON
        if not alone:
            return False
    return True
