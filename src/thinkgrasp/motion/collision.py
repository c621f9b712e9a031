"""Is the arm free there? A MuJoCo model of the arm, what stands still around it, and the perceived cloud.

The cloud comes from a camera, never from a simulator's state.
"""
# MuJoCo's bindings carry no types.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from thinkgrasp.motion.arm_spec import ARM_JOINTS, GRIPPER_JOINTS, GROUP, add_arm
from thinkgrasp.motion.cell import STATICS, StaticBox
from thinkgrasp.motion.height_map import HeightMap
from thinkgrasp.motion.mount import ArmMount
from thinkgrasp.motion.robotiq_2f85 import crank_angle

Float = NDArray[np.float64]

Phase = Literal["transfer", "contact"]
"""How much has to be kept away from. "transfer": everything, with clearance. "contact", the last centimetres at the
object: what stands still without clearance, and the cloud by the arm alone, not by the gripper nor what it holds; the
grasp checks look at the gripper against every single point."""

_ARM, _GRIPPER, _STATIC, _CLOUD, _CARRIED = 1, 2, 4, 8, 16
_OWN_M = 0.03
"""Points nearer to the arm than this are its own."""
_CLOUD_NAME, _CARRIED_NAME = "cloud", "carried"
_GRIPPER_BODIES = ("gripper", "right_crank", "right_finger", "left_crank", "left_finger")
_CLEAR_OF_CARRIED = ("shoulder_pan_link", "shoulder_lift_link", "elbow_link")
"""Links that what is carried can meet; the wrist is always beside it."""


@dataclass(frozen=True, eq=False)
class CarriedBox:
    """What the gripper holds, as a box that moves with the flange."""

    T_flange_box: Float
    """(4, 4) centre and axes."""
    half_m: tuple[float, float, float]


class PlanningWorld:
    """Arm, gripper, static boxes, cloud, and what is carried.

    Args:
        statics: Boxes that stand still.
        clearance_m: How far transfers keep away from them. The cloud has its clearance in the map of heights, which
            widens everything by one to two spacings.
        map: Where heights are kept, and how finely.
        mount: Where the arm stands and the gripper sits; by default at the world's origin, right on the flange.
    """

    def __init__(
        self,
        statics: Sequence[StaticBox] = STATICS,
        *,
        clearance_m: float = 0.01,
        map: HeightMap | None = None,
        mount: ArmMount | None = None,
    ) -> None:
        self.statics = tuple(statics)
        self.clearance_m = clearance_m
        self.map = map or HeightMap()
        self.mount = mount or ArmMount()
        self._heights = np.zeros(self.map.shape)
        self._phase: Phase | None = None
        self._compile(None)

    def see(self, points_m: NDArray[np.floating], arm_at: NDArray[np.floating] | None = None) -> None:
        """Replace the cloud.

        Args:
            points_m: (P, 3) in the world [m], without those of what is carried.
            arm_at: (6,) where the arm was when they were seen [rad]: what they show of the arm is left out.
        """
        self._heights = self.map.heights(points_m)
        if arm_at is not None:
            index, tops = self.map.tops(self._heights)
            self._heights.ravel()[index[self._on_arm(tops, arm_at)]] = 0.0
        self._model.hfield_data[:] = self._heights.ravel()

    def _on_arm(self, points_m: Float, q: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (P,) True for points within _OWN_M of the arm or its gripper."""
        model, data = self._model, self._data
        data.qpos[self._arm_at], data.qpos[self._gripper_at] = q, 0.0
        mujoco.mj_kinematics(model, data)
        near = np.zeros(len(points_m), bool)
        for geom in self._robot_geoms:
            local = (points_m - data.geom_xpos[geom]) @ data.geom_xmat[geom].reshape(3, 3)
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
                radius, half, _ = model.geom_size[geom]
                local[:, 2] -= np.clip(local[:, 2], -half, half)
                near |= np.linalg.norm(local, axis=1) < radius + _OWN_M
            else:
                near |= (np.abs(local) < model.geom_size[geom] + _OWN_M).all(axis=1)
        return near

    def carry(self, box: CarriedBox | None) -> None:
        """Attach a box to the gripper, or take it off."""
        if box is not None or self._carried:
            self._compile(box)

    def collides(self, q: NDArray[np.floating], opening_m: float, phase: Phase = "transfer") -> NDArray[np.bool_]:
        """Return (M,) True where the arm at q (M, 6) [rad] touches something, the gripper open by `opening_m`."""
        self._enter(phase)
        model, data = self._model, self._data
        data.qpos[self._gripper_at] = crank_angle(opening_m) * self._gripper_signs
        hit = np.zeros(len(q), bool)
        for i, joints in enumerate(np.asarray(q, np.float64)):
            data.qpos[self._arm_at] = joints
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            hit[i] = data.ncon > 0
        return hit

    def robot_along(self, q: NDArray[np.floating], opening_m: float, origin: Float, directions: Float) -> Float:
        """Return how far along rays the robot begins, at one configuration.

        Args:
            q: (6,) [rad].
            opening_m: Of the gripper.
            origin: (3,) where all rays start, world [m].
            directions: (N, 3), world, of any length but 0.

        Returns:
            (N,) in lengths of the ray's direction; inf where it misses the robot.
        """
        model, data = self._model, self._data
        data.qpos[self._arm_at], data.qpos[self._gripper_at] = q, crank_angle(opening_m) * self._gripper_signs
        mujoco.mj_kinematics(model, data)
        n, group = len(directions), np.zeros((6, 1), np.uint8)
        group[GROUP] = 1
        geoms, distances = np.empty((n, 1), np.int32), np.empty((n, 1))
        flat = np.ascontiguousarray(directions, np.float64).reshape(-1, 1)
        point = np.array(origin, np.float64).reshape(3, 1)
        mujoco.mj_multiRay(model, data, point, flat, group, True, -1, geoms, distances, None, n, 1e10)
        return np.where(geoms[:, 0] >= 0, distances[:, 0], np.inf)

    def contacts(self, q: NDArray[np.floating], opening_m: float, phase: Phase = "transfer") -> tuple[str, ...]:
        """Say what touches what at one configuration q (6,) [rad], as "wrist_1_link - mount_pole"."""
        self.collides(np.asarray(q)[None], opening_m, phase)
        pairs = (tuple(sorted(self._name(g) for g in pair)) for pair in self._data.contact.geom)
        return tuple(dict.fromkeys(f"{a} - {b}" for a, b in pairs))

    def _name(self, geom: int) -> str:
        body = self._model.geom_bodyid[geom]
        return self._model.body(body).name if body and geom != self._carried else self._model.geom(geom).name or "base"

    def _compile(self, carried: CarriedBox | None) -> None:
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        add_arm(spec, self.mount)
        for geom in spec.geoms:
            if geom.parent.name in _GRIPPER_BODIES:
                geom.contype, geom.conaffinity = _GRIPPER, _STATIC | _CLOUD
            else:
                meets_carried = _CARRIED if geom.parent.name in _CLEAR_OF_CARRIED else 0
                geom.contype, geom.conaffinity = _ARM, _ARM | _GRIPPER | _STATIC | _CLOUD | meets_carried
        for box in self.statics:
            geom = spec.worldbody.add_geom(
                name=box.name, type=mujoco.mjtGeom.mjGEOM_BOX, pos=box.center_m, size=box.half_m
            )
            geom.contype, geom.conaffinity, geom.margin = _STATIC, 0, self.clearance_m
        self._add_cloud(spec)
        if carried is not None:
            geom = spec.body("gripper").add_geom(
                name=_CARRIED_NAME, type=mujoco.mjtGeom.mjGEOM_BOX, size=carried.half_m, pos=carried.T_flange_box[:3, 3]
            )
            mujoco.mju_mat2Quat(geom.quat, carried.T_flange_box[:3, :3].ravel())
            geom.contype, geom.conaffinity = _CARRIED, _STATIC | _CLOUD
        self._model = spec.compile()
        self._model.hfield_data[:] = self._heights.ravel()
        self._data = mujoco.MjData(self._model)
        self._find_parts()
        self._carried = self._model.geom(_CARRIED_NAME).id if carried is not None else 0

    def _add_cloud(self, spec: mujoco.MjSpec) -> None:
        (x0, x1), (y0, y1) = self.map.x_m, self.map.y_m
        rows, columns = self.map.shape
        size = ((x1 - x0) / 2, (y1 - y0) / 2, 1.0, 0.01)
        spec.add_hfield(name=_CLOUD_NAME, size=size, nrow=rows, ncol=columns, userdata=np.zeros(rows * columns))
        geom = spec.worldbody.add_geom(
            name=_CLOUD_NAME,
            type=mujoco.mjtGeom.mjGEOM_HFIELD,
            hfieldname=_CLOUD_NAME,
            pos=((x0 + x1) / 2, (y0 + y1) / 2, 0.0),
        )
        geom.contype, geom.conaffinity = _CLOUD, 0

    def _find_parts(self) -> None:
        model = self._model
        self._arm_at = np.array([model.joint(name).qposadr[0] for name in ARM_JOINTS])
        self._gripper_at = np.array([model.joint(name).qposadr[0] for name in GRIPPER_JOINTS])
        self._gripper_signs = np.array([1.0 if "crank" in name else -1.0 for name in GRIPPER_JOINTS])
        bodies = [model.body(name).id for name in _GRIPPER_BODIES]
        self._gripper_geoms = np.flatnonzero(np.isin(model.geom_bodyid, bodies))
        self._robot_geoms = np.flatnonzero((model.geom_contype & (_ARM | _GRIPPER)) != 0)
        self._static_geoms = np.array([model.geom(box.name).id for box in self.statics], np.intp)
        self._phase = None

    def _enter(self, phase: Phase) -> None:
        if phase == self._phase:
            return
        affinity = self._model.geom_conaffinity
        affinity[self._gripper_geoms] &= ~_CLOUD
        affinity[self._gripper_geoms] |= _CLOUD if phase == "transfer" else 0
        self._model.geom_margin[self._static_geoms] = self.clearance_m if phase == "transfer" else 0.0
        self._phase = phase
