"""The simulated cell: table, bin, camera mount, UR5e with a 2F-85, and the objects, under MuJoCo's physics.

World frame: the robot's base on the table plane, z up, x forward. The world holds the truth; what the pipeline sees of
it goes through a camera (`thinkgrasp.cameras.simulated`) and carries none of it.
"""

# MuJoCo's bindings carry no types.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import make_transform
from thinkgrasp.motion.arm_spec import ARM_JOINTS, GRIPPER_JOINTS, PADS, add_arm
from thinkgrasp.motion.cell import BIN, HOME_RAD, STATICS, StaticBox
from thinkgrasp.motion.robotiq_2f85 import CLOSED_RAD, STROKE_M, crank_angle, opening
from thinkgrasp.sim.objects import CollisionPiece, SimObject, VisualPiece
from thinkgrasp.sim.rays import OBJECT_GROUP, ROBOT_GROUP, STATIC_GROUP, Hits, cast
from thinkgrasp.sim.views import CameraView
from thinkgrasp.types import CameraIntrinsics

TIMESTEP_S = 0.002
FLOOR_Z_M = -0.75
TABLE_LIMITS_M = ((-0.35, 1.05), (-0.60, 0.80))
"""Extent of the table top along x and y."""
COLLISION_GROUP = 3
"""Geom group of the objects' collision shapes; no camera sees it."""
GRIP_FORCE_N = 50.0
"""What each pad presses with; the 2F-85 is made for 20 to 235 N."""
NO_FRICTION = 0.01
"""Of pads, table, bin and mount: of two that touch MuJoCo takes the larger coefficient, so the object's counts."""
_PARKED_Z_M = -5.0
_VIEWS_KEPT = 4
_AT_REST_M_S, _AT_REST_RAD_S = 0.01, 0.2
_SHAPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
}
_ROLLING_TIME_S = 0.15
"""A thing that rolls freely slows down to a third in this time: cloth, not glass."""


class World:
    """Physics of the cell with these objects; they are out of the world until placed.

    Args:
        objects: What may be put on the table.
        robot: Whether the arm stands there; piles settle faster without it.

    Raises:
        InputError: An object cannot be compiled, for example because a hull is flat.
    """

    def __init__(self, objects: Sequence[SimObject], *, robot: bool = True) -> None:
        self.objects = tuple(objects)
        self._centers = [obj.bounds_m.mean(axis=0) for obj in self.objects]
        spec = _cell_spec()
        if robot:
            add_arm(spec)
            _add_drives(spec)
        pieces = [_add_object(spec, index, obj) for index, obj in enumerate(self.objects)]
        try:
            self.model = spec.compile()
        except ValueError as error:
            named = {_body_name(i): repr(obj.name) for i, obj in enumerate(self.objects)}
            what = re.sub(r"object_\d+", lambda m: named.get(m.group(), m.group()), " ".join(str(error).split()))
            raise InputError(f"the simulator refuses an object: {what}") from error
        self.data = mujoco.MjData(self.model)
        self.has_robot = robot
        self._bodies = np.array([self.model.body(_body_name(i)).id for i in range(len(self.objects))], np.intp)
        self._joint_at = self.model.body_jntadr[self._bodies]
        self._qpos_at = self.model.jnt_qposadr[self._joint_at].astype(np.intp)
        self._dof_at = self.model.jnt_dofadr[self._joint_at].astype(np.intp)
        owner = np.full(self.model.nbody, -1, np.intp)
        owner[self._bodies] = np.arange(len(self.objects))
        self.object_of_geom: NDArray[np.intp] = owner[self.model.geom_bodyid]
        self.visuals: Mapping[int, VisualPiece] = MappingProxyType(
            {self.model.geom(name).id: piece for names in pieces for name, piece in names.items()}
        )
        self._set_masses()
        for index in range(len(self.objects)):
            self.park(index)
        self._robot_geoms = self.model.geom_group == ROBOT_GROUP
        self._last_hits: dict[tuple[CameraIntrinsics, bytes], tuple[bytes, Hits]] = {}
        if robot:
            self._pads = np.array([self.model.geom(name).id for name in PADS])
            self.set_joints(np.array(HOME_RAD), 0.085)
        mujoco.mj_forward(self.model, self.data)

    # -- objects -----------------------------------------------------------------------------------------------------

    def place(self, index: int, T_world_object: NDArray[np.float64]) -> None:
        """Put an object at rest at a pose (4, 4)."""
        self._set_pose(index, T_world_object)
        self.model.body_gravcomp[self._bodies[index]] = 0.0
        mujoco.mj_kinematics(self.model, self.data)

    def park(self, index: int) -> None:
        """Take an object out of the world."""
        self._set_pose(index, make_transform(np.eye(3), np.array([float(index), 0.0, _PARKED_Z_M])))
        self.model.body_gravcomp[self._bodies[index]] = 1.0
        mujoco.mj_kinematics(self.model, self.data)

    def _set_pose(self, index: int, T: NDArray[np.float64]) -> None:
        at, dof = self._qpos_at[index], self._dof_at[index]
        self.data.qpos[at : at + 3] = T[:3, 3]
        self.data.qpos[at + 3 : at + 7] = np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)
        self.data.qvel[dof : dof + 6] = 0.0

    def pose(self, index: int) -> NDArray[np.float64]:
        """Return T_world_object (4, 4)."""
        at = self._qpos_at[index]
        w, x, y, z = self.data.qpos[at + 3 : at + 7]
        return make_transform(Rotation.from_quat([x, y, z, w]).as_matrix(), self.data.qpos[at : at + 3])

    def poses(self) -> NDArray[np.float64]:
        """Return T_world_object of all objects, (N, 4, 4)."""
        return np.array([self.pose(i) for i in range(len(self.objects))]).reshape(-1, 4, 4)

    def speed(self, index: int) -> tuple[float, float]:
        """Return an object's speed [m/s] and rate of turn [rad/s]."""
        v = self.data.qvel[self._dof_at[index] : self._dof_at[index] + 6]
        return float(np.linalg.norm(v[:3])), float(np.linalg.norm(v[3:]))

    def is_parked(self, index: int) -> bool:
        """Whether an object is out of the world."""
        return bool(self.data.qpos[self._qpos_at[index] + 2] < _PARKED_Z_M / 2)

    def in_bin(self, index: int) -> bool:
        """Whether an object's centre lies in the bin."""
        return bool(BIN.contains(self.center(index)))

    def on_table(self, index: int) -> bool:
        """Whether an object is on or above the table top, and not in the bin."""
        x, y, z = self.center(index)
        (x0, x1), (y0, y1) = TABLE_LIMITS_M
        return bool(x0 <= x <= x1 and y0 <= y <= y1 and z > -0.01 and not self.in_bin(index))

    def center(self, index: int) -> NDArray[np.float64]:
        """Return the world position (3,) of an object's bounding box centre."""
        T = self.pose(index)
        return T[:3, :3] @ self._centers[index] + T[:3, 3]

    # -- rays --------------------------------------------------------------------------------------------------------

    def hits(self, view: CameraView) -> Hits:
        """Return what each pixel (H*W) of a view shows, with normals; cast anew only where something has moved."""
        d = self.data
        state = b"".join(array.tobytes() for array in (d.geom_xpos, d.geom_xmat, self.model.geom_group))
        key = view.intrinsics, view.T_world_camera.tobytes()
        before, hits = self._last_hits.pop(key, (b"", None))
        if hits is None or before != state:
            hits = cast(self.model, d, view.eye, view.rays, normals=True)
            for array in (hits.geoms, hits.distances, hits.normals):
                array.flags.writeable = False
        self._last_hits[key] = state, hits
        while len(self._last_hits) > _VIEWS_KEPT:
            del self._last_hits[next(iter(self._last_hits))]
        return hits

    # -- time --------------------------------------------------------------------------------------------------------

    def step(self, n: int = 1) -> None:
        """Let time pass: n steps of TIMESTEP_S."""
        mujoco.mj_step(self.model, self.data, n)

    @property
    def time_s(self) -> float:
        """Simulated time."""
        return float(self.data.time)

    def settle(self, *, max_seconds: float = 3.0) -> bool:
        """Let time pass until every object is at rest; return whether that came true in time."""
        for _ in range(int(max_seconds / TIMESTEP_S / 25)):
            self.step(25)
            if self.at_rest():
                return True
        return False

    def at_rest(self) -> bool:
        """Whether no object moves."""
        if not self.objects:
            return True
        v = np.abs(self.data.qvel[self._dof_at[:, None] + np.arange(6)])
        return bool((v[:, :3] < _AT_REST_M_S).all() and (v[:, 3:] < _AT_REST_RAD_S).all())

    def drop(
        self, order: Sequence[tuple[int, NDArray[np.float64]]], *, interval_s: float = 0.15, max_seconds: float = 3.0
    ) -> bool:
        """Let objects fall one after another, then settle; return whether all came to rest."""
        for index, T in order:
            self.place(index, T)
            self.step(round(interval_s / TIMESTEP_S))
        return self.settle(max_seconds=max_seconds)

    # -- robot -------------------------------------------------------------------------------------------------------

    def joints(self) -> NDArray[np.float64]:
        """Return the arm's joint angles (6,) [rad]."""
        return self.data.qpos[: len(ARM_JOINTS)].copy()

    def opening(self) -> float:
        """Return the opening between the pads [m]."""
        right, left = self.data.qpos[len(ARM_JOINTS)], self.data.qpos[len(ARM_JOINTS) + 2]
        return float(np.clip((opening(right) + opening(left)) / 2, 0.0, STROKE_M))

    def set_joints(self, q: NDArray[np.float64], opening_m: float) -> None:
        """Put the arm at rest at joint angles (6,) with a gripper opening, without passing through time."""
        n = len(ARM_JOINTS)
        crank = float(crank_angle(opening_m))
        self.data.qpos[:n] = q
        self.data.qpos[n : n + len(GRIPPER_JOINTS)] = (crank, -crank, crank, -crank)
        self.data.qvel[: n + len(GRIPPER_JOINTS)] = 0.0
        self.command(q, np.zeros(n))
        self.command_gripper(opening_m)
        mujoco.mj_kinematics(self.model, self.data)

    def command(self, q: NDArray[np.float64], velocity: NDArray[np.float64]) -> None:
        """Set the arm's targets: angles (6,) [rad] and, so that the servos do not lag, velocities (6,) [rad/s]."""
        self.data.ctrl[: len(ARM_JOINTS)] = q + velocity * _SERVO_LEAD_S

    def command_gripper(self, opening_m: float, force_n: float = GRIP_FORCE_N) -> None:
        """Set the opening that the gripper goes to, and what each pad presses with at most."""
        self.data.ctrl[len(ARM_JOINTS)] = CLOSED_RAD if opening_m <= 0 else float(crank_angle(opening_m))
        torque = 2 * force_n * _CRANK_ARM_M
        self.model.actuator_forcerange[len(ARM_JOINTS)] = (-torque, torque)

    def flange(self) -> NDArray[np.float64]:
        """Return T_world_flange (4, 4)."""
        body = self.data.body("gripper")
        return make_transform(body.xmat.reshape(3, 3), body.xpos)

    def pad_contacts(self) -> list[set[int]]:
        """Return the objects that the right and the left finger pad touch."""
        touched: list[set[int]] = [set(), set()]
        if self.data.ncon == 0:
            return touched
        pairs, active = self.data.contact.geom, self.data.contact.efc_address >= 0
        for side, pad in enumerate(self._pads):
            for first, second in ((0, 1), (1, 0)):
                mine = (pairs[:, first] == pad) & active
                touched[side] |= {int(o) for o in self.object_of_geom[pairs[mine, second]] if o >= 0}
        return touched

    def held(self) -> int | None:
        """Return the object between the fingers that touches both of them, or None."""
        right, left = self.pad_contacts()
        both = sorted(right & left)
        return both[0] if both else None

    def collision_force(self, held: int | None = None) -> float:
        """Return the largest force [N] of the robot, with what it holds, against anything else."""
        if self.data.ncon == 0:
            return 0.0
        pairs = self.data.contact.geom
        moving = self._robot_geoms if held is None else self._robot_geoms | (self.object_of_geom == held)
        force, largest = np.zeros(6), 0.0
        for i in np.flatnonzero(moving[pairs[:, 0]] != moving[pairs[:, 1]]).tolist():
            mujoco.mj_contactForce(self.model, self.data, i, force)
            largest = max(largest, float(np.linalg.norm(force[:3])))
        return largest

    def _set_masses(self) -> None:
        """Scale the bodies, compiled at unit density, to the objects' masses; damp rolling."""
        for index, obj in enumerate(self.objects):
            body, dof = self._bodies[index], self._dof_at[index]
            scale = obj.mass_kg / self.model.body_mass[body]
            self.model.body_mass[body] *= scale
            self.model.body_inertia[body] *= scale
            self.model.dof_damping[dof + 3 : dof + 6] = self.model.body_inertia[body].mean() / _ROLLING_TIME_S
        mujoco.mj_setConst(self.model, self.data)


_SERVO_KP = (6000.0, 6000.0, 4000.0, 1200.0, 1200.0, 800.0)
_SERVO_LEAD_S = 0.05
"""Damping over stiffness of every servo: by how much it lags behind a moving target that has no lead."""
_CRANK_ARM_M = 0.05
"""Lever of a pad on its crank's pivot, about the middle of the stroke."""


def _cell_spec() -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    option = spec.option
    option.timestep = TIMESTEP_S
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    world = spec.worldbody
    (x0, x1), (y0, y1) = TABLE_LIMITS_M
    table = StaticBox("table", ((x0 + x1) / 2, (y0 + y1) / 2, -0.02), ((x1 - x0) / 2, (y1 - y0) / 2, 0.02))
    for box in (table, *(b for b in STATICS if b.name != "table")):
        rgba = _STATIC_COLORS.get(box.name.split("_")[0], (0.35, 0.36, 0.38, 1.0))
        geom = world.add_geom(
            name=box.name, type=mujoco.mjtGeom.mjGEOM_BOX, pos=box.center_m, size=box.half_m, rgba=rgba
        )
        geom.group, geom.condim, geom.friction = STATIC_GROUP, 4, (NO_FRICTION, 0.005, 0.0001)
    floor = world.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_BOX, pos=(0, 0, FLOOR_Z_M - 0.05), size=(5, 5, 0.05)
    )
    floor.rgba, floor.group = (0.28, 0.28, 0.29, 1.0), STATIC_GROUP
    return spec


_STATIC_COLORS = {"table": (0.62, 0.60, 0.57, 1.0), "bin": (0.30, 0.36, 0.42, 1.0)}


def _add_drives(spec: mujoco.MjSpec) -> None:
    for joint, kp in zip(ARM_JOINTS, _SERVO_KP, strict=True):
        drive = spec.add_actuator(name=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint)
        drive.set_to_position(kp=kp, kv=kp * _SERVO_LEAD_S)
    tendon = spec.add_tendon(name="grip")
    for side in ("right", "left"):
        tendon.wrap_joint(f"{side}_crank", 0.5)
    drive = spec.add_actuator(name="grip", trntype=mujoco.mjtTrn.mjTRN_TENDON, target="grip")
    drive.set_to_position(kp=120.0, kv=6.0)
    drive.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    drive.forcerange = (-5.0, 5.0)


def _body_name(index: int) -> str:
    return f"object_{index}"


def _add_object(spec: mujoco.MjSpec, index: int, obj: SimObject) -> dict[str, VisualPiece]:
    """Add one object; return its visual pieces by geom name."""
    name = _body_name(index)
    body = spec.worldbody.add_body(name=name, pos=(index, 0, _PARKED_Z_M), gravcomp=1.0)
    body.add_freejoint()
    named: dict[str, VisualPiece] = {}
    for k, piece in enumerate(obj.visuals):
        mesh = spec.add_mesh(name=f"{name}_visual_{k}")
        mesh.uservert, mesh.userface = piece.vertices.ravel().tolist(), piece.faces.ravel().tolist()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        geom = body.add_geom(
            name=f"{name}_visual_{k}",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh.name,
            rgba=(*piece.color, 1.0),
            group=OBJECT_GROUP,
            mass=0.0,
        )
        geom.contype = geom.conaffinity = 0
        named[geom.name] = piece
    for k, piece in enumerate(obj.collisions):
        _add_collision(spec, body, f"{name}_collision_{k}", piece, obj.friction)
    return named


def _add_collision(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, piece: CollisionPiece, friction: float
) -> None:
    if piece.shape == "hull":
        if piece.points_m is None or len(piece.points_m) < 4:
            raise InputError(f"{name}: a hull needs at least 4 points")
        mesh = spec.add_mesh(name=name)
        mesh.uservert = np.asarray(piece.points_m, np.float32).ravel().tolist()
        geom = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    else:
        size = (*piece.size_m, 0.0, 0.0, 0.0)[:3]
        geom = body.add_geom(
            name=name, type=_SHAPES[piece.shape], size=size, pos=piece.position_m, quat=piece.quat_wxyz
        )
    geom.group, geom.condim = COLLISION_GROUP, 4
    geom.friction = (friction, 0.008, 0.0002)
    geom.density = 1000.0
