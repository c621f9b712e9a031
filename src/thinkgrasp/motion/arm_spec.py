"""UR5e with a Robotiq 2F-85 as MuJoCo bodies: the same for planning and for simulated physics.

Bodies sit on the Denavit-Hartenberg frames of `thinkgrasp.motion.ur5e`, links are capsules around the real ones. World
and base frame coincide unless a mount says otherwise. Joints in qpos order: ARM_JOINTS, then GRIPPER_JOINTS.
"""

# MuJoCo's bindings carry no types.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import mujoco
import numpy as np

from thinkgrasp.motion import robotiq_2f85 as linkage
from thinkgrasp.motion.mount import ArmMount
from thinkgrasp.motion.ur5e import DH

ARM_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
GRIPPER_JOINTS = ("right_crank", "right_finger", "left_crank", "left_finger")
PADS = ("right_pad", "left_pad")
GROUP = 1

_LINK_MASSES_KG = (3.761, 8.058, 2.846, 1.37, 1.3, 0.365)
"""UR5e links, as in the maker's DH and dynamics table."""
_GREY, _DARK, _BLUE = (0.72, 0.73, 0.75, 1), (0.16, 0.16, 0.17, 1), (0.35, 0.55, 0.72, 1)
_SHOULDER_OFFSET_M, _FOREARM_OFFSET_M = 0.138, 0.007
"""Where upper arm and forearm run beside the frames of shoulder and elbow, along the joint axis."""


def add_arm(spec: mujoco.MjSpec, mount: ArmMount | None = None) -> None:
    """Add the arm and its gripper to the world body of a spec whose angles are in radians."""
    mount = mount or ArmMount()
    body = spec.worldbody
    bx, by, bz = (float(c) for c in mount.T_world_base[:3, 3])
    turn = ArmMount.yaw(mount.T_world_base) / 2
    _capsule(body, (bx, by, bz), (bx, by, bz + 0.10), 0.07, _GREY)
    for i, (joint, row, mass) in enumerate(zip(ARM_JOINTS, DH, _LINK_MASSES_KG, strict=True)):
        a, d, alpha = DH[i - 1] if i else (0.0, 0.0, 0.0)
        pos, quat = (a, 0, d), (np.cos(alpha / 2), np.sin(alpha / 2), 0, 0)
        if i == 0:
            pos, quat = (bx, by, bz), (np.cos(turn), 0, 0, np.sin(turn))
        body = body.add_body(name=f"{joint}_link", pos=pos, quat=quat)
        body.gravcomp = 1
        body.add_joint(name=joint, type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 0, 1), armature=0.1)
        body.explicitinertial = True
        body.mass, body.ipos, body.inertia = mass, (row[0] / 2, 0, row[1] / 2), _link_inertia(mass, row)
        _add_link(body, joint)
    turn = ArmMount.yaw(mount.T_flange_gripper) / 2
    palm = body.add_body(
        name="gripper", pos=(0, 0, DH[5][1] + mount.coupling_m), quat=(np.cos(turn), 0, 0, np.sin(turn))
    )
    _add_gripper(palm)
    spec.add_exclude(bodyname1="shoulder_pan_link", bodyname2="world")
    spec.add_exclude(bodyname1="wrist_3_link", bodyname2="wrist_1_link")
    for side in ("right", "left"):
        spec.add_exclude(bodyname1="gripper", bodyname2=f"{side}_finger")
        _couple(spec, f"{side}_finger", f"{side}_crank", -1.0)
    spec.add_exclude(bodyname1="gripper", bodyname2="wrist_2_link")
    spec.add_exclude(bodyname1="right_crank", bodyname2="left_crank")
    _couple(spec, "left_crank", "right_crank", 1.0)


def _link_inertia(mass: float, row: tuple[float, float, float]) -> tuple[float, float, float]:
    length = max(abs(row[0]), abs(row[1]), 0.1)
    slim, long = mass * 0.05**2, mass * (length**2 / 12 + 0.05**2 / 2)
    return slim, long, long


def _add_link(body: mujoco.MjsBody, joint: str) -> None:
    a2, a3, d4, d5 = DH[1][0], DH[2][0], DH[3][1], DH[4][1]
    d1 = DH[0][1]
    match joint:
        case "shoulder_pan":
            _capsule(body, (0, 0, d1 - 0.03), (0, 0, d1), 0.060, _GREY)
            _capsule(body, (0, 0, d1), (0, -_SHOULDER_OFFSET_M + 0.05, d1), 0.058, _BLUE)
        case "shoulder_lift":
            _capsule(body, (0, 0, _SHOULDER_OFFSET_M), (a2, 0, _SHOULDER_OFFSET_M), 0.055, _GREY)
        case "elbow":
            _capsule(body, (0, 0, _SHOULDER_OFFSET_M - 0.02), (0, 0, _FOREARM_OFFSET_M), 0.052, _BLUE)
            _capsule(body, (0, 0, _FOREARM_OFFSET_M), (a3, 0, _FOREARM_OFFSET_M), 0.045, _GREY)
        case "wrist_1":
            _capsule(body, (0, 0, 0.02), (0, 0, d4), 0.040, _BLUE)
        case "wrist_2":
            _capsule(body, (0, 0, 0.0), (0, 0, d5), 0.040, _GREY)
        case _:
            _capsule(body, (0, 0, 0.03), (0, 0, DH[5][1] - 0.035), 0.034, _BLUE)


def _add_gripper(palm: mujoco.MjsBody) -> None:
    palm.gravcomp = 1
    _box(palm, (0, 0, 0.036), (0.038, 0.036, 0.036), 0.6, _DARK)
    for side, s in (("right", 1), ("left", -1)):
        pivot = (s * linkage.PIVOT_X_M, 0, linkage.PIVOT_Z_M)
        crank = palm.add_body(name=f"{side}_crank", pos=pivot, gravcomp=1)
        _hinge(crank, f"{side}_crank", s, (0, linkage.CLOSED_RAD + 0.02))
        end = (s * linkage.CRANK_X_M, 0, linkage.CRANK_Z_M)
        _capsule(crank, (0, 0, 0.004), end, 0.008, _GREY, mass=0.05)
        finger = crank.add_body(name=f"{side}_finger", pos=end, gravcomp=1)
        _hinge(finger, f"{side}_finger", s, (-linkage.CLOSED_RAD - 0.1, 0.1))
        thickness, _, length = linkage.PAD_HALF_M
        pad_x, pad_z = linkage.PAD_X_M, linkage.PAD_Z_M
        back_x = pad_x + thickness + 0.0035
        _box(finger, (s * back_x, 0, pad_z - 0.008), (0.0035, 0.010, length + 0.006), 0.04, _DARK)
        _box(finger, (s * back_x / 2, 0, 0.0), (abs(back_x) / 2 + 0.004, 0.009, 0.007), 0.02, _DARK)
        pad = _box(finger, (s * pad_x, 0, pad_z), linkage.PAD_HALF_M, 0.02, _DARK)
        pad.name = f"{side}_pad"
        pad.friction, pad.condim = (0.01, 0.01, 0.0001), 4
        pad.solref, pad.solmix = (0.004, 1.0), 1000.0


def _hinge(body: mujoco.MjsBody, name: str, side: int, limits: tuple[float, float]) -> None:
    joint = body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, -side, 0), range=limits)
    joint.armature, joint.damping, joint.limited = 0.005, (0.02, 0, 0), mujoco.mjtLimited.mjLIMITED_TRUE


def _couple(spec: mujoco.MjSpec, joint: str, driver: str, ratio: float) -> None:
    data = np.zeros(mujoco.mjNEQDATA)
    data[1] = ratio
    spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT,
        name1=joint,
        name2=driver,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        data=data,
        solref=(0.005, 1.0),
    )


def _capsule(
    body: mujoco.MjsBody,
    start: tuple[float, float, float],
    end: tuple[float, float, float],
    radius: float,
    rgba: tuple[float, ...],
    mass: float = 0.0,
) -> mujoco.MjsGeom:
    return body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=(*start, *end),
        size=(radius, 0, 0),
        rgba=rgba,
        group=GROUP,
        mass=mass,
    )


def _box(
    body: mujoco.MjsBody,
    pos: tuple[float, float, float],
    half: tuple[float, float, float],
    mass: float,
    rgba: tuple[float, ...],
) -> mujoco.MjsGeom:
    return body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=pos, size=half, rgba=rgba, group=GROUP, mass=mass)
