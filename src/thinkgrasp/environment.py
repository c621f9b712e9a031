"""The simulated cell as Gymnasium environments, for policies that choose grasps.

Importing this module registers "ThinkGrasp/Clutter-v1" and "ThinkGrasp/Heavy-v1":

    import gymnasium
    import thinkgrasp.environment

    env = gymnasium.make("ThinkGrasp/Clutter-v1", action="pixel")

Gymnasium 1 looks for no plug-ins by itself; without the second import,
`gymnasium.make("thinkgrasp.environment:ThinkGrasp/Clutter-v1")` finds them as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, InputError, MissingDependency
from thinkgrasp.geometry import invert, make_transform, quat_wxyz, rotation_from_quat_wxyz
from thinkgrasp.motion.robotiq_2f85 import STROKE_M
from thinkgrasp.types import Array, Frame, Grasp, Outcome

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.error import ResetNeeded

    from thinkgrasp.cameras.simulated import default_workspace
    from thinkgrasp.robots.simulated import Truth
    from thinkgrasp.sim.render import FAR_M, render
    from thinkgrasp.sim.scenes import PiledScene
    from thinkgrasp.sim.tasks import STEP_LIMIT, TASKS, Suite, Task, find_task
    from thinkgrasp.sim.truth import visible_fraction
    from thinkgrasp.sim.views import default_view, film_view
    from thinkgrasp.testbed import Attempt, CameraOptions, Session
except ModuleNotFoundError as error:
    raise MissingDependency(str(error.name), "sim", "the Gymnasium environment") from error

ActionKind = Literal["pose", "pixel"]
NoPoint = Literal["no_depth", "outside_workspace"]
IDS: dict[Suite, str] = {"clutter": "ThinkGrasp/Clutter-v1", "heavy": "ThinkGrasp/Heavy-v1"}

PIXEL_DEPTH_M = 0.02
"""How far below the surface point of a pixel action the fingertips close."""
LOWEST_TIP_M = 0.005
"""The fingertips of a pixel action stay this far above the table."""
INSTRUCTION_CHARS = 200
SEEDS_TO_TRY = 4
"""Piles that may fail before `reset` does."""
_PRINTABLE = "".join(map(chr, range(32, 127)))
_OPTIONS = ("task", "visibility", "scene_seed")


Observation = dict[str, Any]


@dataclass(eq=False)
class _Episode:
    task: Task
    session: Session
    frame: Frame
    attempts: int = 0


class GraspingEnv(gymnasium.Env[Observation, NDArray[Any]]):
    """Clear a pile with grasps until a goal of the instruction lies in the bin; one step is one whole attempt.

    World coordinates are those of the robot's base, z up out of the table. An observation has

    - "color" (H, W, 3) uint8 RGB,
    - "depth" (H, W) float32 along the optical axis [m], 0 = no return,
    - "instruction", a sentence.

    An action is a float32 vector:

    - "pose" (8,): position x, y, z of the point midway between the fingertips [m], within the workspace above the
      table; orientation as a quaternion w, x, y, z of any length (+z approach, +x closing), all zeros = from straight
      above, closing along the world's x; opening between the fingers before they close [m].
    - "pixel" (4,): column u and row v, rounded to whole pixels; angle of the closing direction about the world's
      vertical, from its x axis [rad]; opening [m]. The gripper comes from straight above, and its tips close
      PIXEL_DEPTH_M below the pixel's point, but not lower than LOWEST_TIP_M above the table.

    An action that cannot be carried out is a failed attempt: it takes one step and `info["outcome"]` says why.

    The reward is 1 at the step in which a goal reaches the bin, and 0 at every other; nothing is taken off for steps.
    The episode terminates when a goal lies in the bin. It is truncated after 15 (clutter) or 50 (heavy) attempts, or
    when nothing is left on the table.

    `info` of reset and step:

    - "outcome": None after a reset; what the robot reports ("held", "missed", "slipped", "unreachable", "collision");
      or, when nothing was executed, "invalid_action" (outside the action space, or not finite), "no_depth" or
      "outside_workspace" (of the pixel).
    - "grasped": name of the object that both fingers held after closing, by contact; None = none.
    - "delivered": name of the object that was put into the bin; None = none.
    - "goals": names of all objects that serve the instruction.
    - "visible": per goal, the share 0..1 of its pixels that nothing hides now; 0 when it has left the image.
    - "attempts": how many there were in this episode.
    - "task", "scene_seed": what makes the same pile again, as options of `reset` (with the same "visibility", if it
      was given) or with `thinkgrasp demo`.

    Everything in `info` but the outcome and the attempts is the simulator's truth: for rewards of one's own and for
    statistics, not for policies.

    Args:
        suite: "clutter" (8 to 15 objects) or "heavy" (20 to 30).
        action: "pose" or "pixel".
        camera: Model of the camera; see `thinkgrasp.sim.views.camera`.
        size_wh: Size of its images [px].
        noise: Whether its depth has the sensor's noise.
        render_mode: "rgb_array" or None.

    Raises:
        ConfigError: No such suite, action, camera, size or render mode.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012 - as in the base class

    def __init__(
        self,
        suite: Suite = "clutter",
        *,
        action: ActionKind = "pose",
        camera: str = "l515",
        size_wh: tuple[int, int] = (224, 224),
        noise: bool = True,
        render_mode: str | None = None,
    ) -> None:
        _check("suite", suite, tuple(STEP_LIMIT))
        _check("kind of action", action, get_args(ActionKind))
        _check("render mode", render_mode, (None, *self.metadata["render_modes"]))
        self.suite: Suite = suite
        self.step_limit = STEP_LIMIT[suite]
        self.render_mode = render_mode
        w, h = size_wh
        self.view = default_view(camera, (w, h))
        self._camera = CameraOptions(camera, (w, h), noise)
        self._action_kind: ActionKind = action
        self._running: _Episode | None = None
        self.action_space = _pose_space() if action == "pose" else _pixel_space(w, h)
        self.observation_space = spaces.Dict(
            {
                "color": spaces.Box(0, 255, (h, w, 3), np.uint8),
                "depth": spaces.Box(0.0, FAR_M, (h, w), np.float32),
                "instruction": spaces.Text(INSTRUCTION_CHARS, charset=_PRINTABLE),
            }
        )

    @property
    def session(self) -> Session:
        """The episode's world, robot and cameras: the simulator's truth, not for policies."""
        return self._episode.session

    @property
    def frame(self) -> Frame:
        """The last observation as the pipeline takes it: with intrinsics, camera pose and workspace."""
        return self._episode.frame

    @property
    def _episode(self) -> _Episode:
        if self._running is None:
            raise ResetNeeded("there is no episode yet; call reset() first")
        return self._running

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Make a new pile.

        Args:
            seed: Of the tasks and piles from now on; None = go on with those drawn so far.
            options: "task": a name of `thinkgrasp.sim.tasks`, instead of a random one of this suite. "visibility" of
                every goal: "visible", "partly" or "hidden", instead of the task's own. "scene_seed" of the pile,
                instead of a random one.

        Returns:
            The observation and the info.

        Raises:
            ConfigError: An option is unknown or has a value that is not allowed.
            InputError: No pile came out as asked for; with a random seed, not with SEEDS_TO_TRY of them.
        """
        super().reset(seed=seed)
        task, scene = self._draw(options or {})
        session = Session(scene, self._camera, seed=scene.spec.seed)
        self._running = _Episode(task, session, session.cameras[0].read())
        return self._observation(), self._info(None)

    def step(self, action: NDArray[np.floating]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Carry out one grasp and put what it holds into the bin.

        Returns:
            Observation, reward, terminated, truncated, info.

        Raises:
            InputError: The action has not the shape of the action space.
        """
        episode, world = self._episode, self.session.world
        attempt = self._attempt(action)
        episode.attempts += 1
        episode.frame = episode.session.cameras[0].read()
        delivered = episode.session.goal_delivered()
        empty = not any(world.on_table(i) for i in range(len(world.objects)))
        truncated = not delivered and (empty or episode.attempts >= self.step_limit)
        return self._observation(), float(delivered), delivered, truncated, self._info(attempt)

    def render(self) -> NDArray[np.uint8] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return a picture (240, 320, 3) of arm, table and bin; None without a render mode."""
        if self.render_mode is None:
            return None
        world = self.session.world
        return render(world.model, world.data, film_view(), world.visuals).color

    def _draw(self, options: dict[str, Any]) -> tuple[Task, PiledScene]:
        """Choose a task and make a pile; a few seeds give none as asked for, then the next one is drawn."""
        if unknown := sorted(set(options) - set(_OPTIONS)):
            raise ConfigError(f"unknown option of reset: {', '.join(unknown)}; allowed are {', '.join(_OPTIONS)}")
        own = [task for task in TASKS if task.suite == self.suite]
        task = own[int(self.np_random.integers(len(own)))]
        if "task" in options:
            task = find_task(options["task"])
        if task not in own:
            names = ", ".join(t.name for t in own)
            raise ConfigError(f"{task.name!r} is no task of {IDS[self.suite]}; its tasks are {names}")
        visibility = options.get("visibility")
        if "scene_seed" in options:
            scene_seed = options["scene_seed"]
            if not isinstance(scene_seed, int):
                raise ConfigError(f"scene_seed must be a whole number, got {scene_seed!r}")
            return task, task.scene(scene_seed, visibility)
        for _ in range(SEEDS_TO_TRY - 1):
            try:
                return task, task.scene(self._scene_seed(), visibility)
            except InputError:
                continue
        return task, task.scene(self._scene_seed(), visibility)

    def _scene_seed(self) -> int:
        return int(self.np_random.integers(2**31))

    def _attempt(self, action: NDArray[np.floating]) -> Attempt:
        values = np.asarray(action, np.float32)
        if values.shape != self.action_space.shape:
            raise InputError(
                f"a {self._action_kind} action has the shape {self.action_space.shape}, got {values.shape}"
            )
        if not self.action_space.contains(values):
            return _not_executed("invalid_action")
        values = values.astype(np.float64)
        T_world_tcp = _from_pose(values) if self._action_kind == "pose" else self._from_pixel(values)
        if isinstance(T_world_tcp, str):
            return _not_executed(T_world_tcp)
        T = invert(self.view.T_world_camera) @ T_world_tcp
        grasp = Grasp(T[:3, :3], T[:3, 3], width_m=min(float(values[-1]), STROKE_M), score=1.0)
        self.session.robot.execute(grasp, self.frame)
        return self.session.robot.attempts[-1]

    def _from_pixel(self, action: NDArray[np.float64]) -> NDArray[np.float64] | NoPoint:
        """Return T_world_tcp (4, 4) of a pixel action, or why there is none."""
        u, v = np.rint(action[:2]).astype(int)
        depth = float(self.frame.depth[v, u])
        if not depth > 0:
            return "no_depth"
        if self.frame.workspace is not None and not self.frame.workspace[v, u]:
            return "outside_workspace"
        point = self.view.eye + depth * self.view.rays[v * self.view.intrinsics.width + u]
        point[2] = max(point[2] - PIXEL_DEPTH_M, LOWEST_TIP_M)
        return make_transform(_top_down(action[2]), point)

    def _observation(self) -> Observation:
        frame = self.frame
        return {
            "color": frame.color.copy(),
            "depth": np.clip(np.nan_to_num(frame.depth), 0.0, FAR_M),
            "instruction": self.session.scene.spec.instruction,
        }

    def _info(self, attempt: Attempt | None) -> dict[str, Any]:
        world, spec = self.session.world, self.session.scene.spec
        grasped = attempt and attempt.truth.touched
        delivered = attempt and attempt.truth.delivered
        return {
            "outcome": attempt and attempt.outcome.reason,
            "grasped": None if grasped is None else world.objects[grasped].name,
            "delivered": None if delivered is None or not world.in_bin(delivered) else world.objects[delivered].name,
            "goals": tuple(world.objects[g].name for g in spec.goals),
            "visible": tuple(visible_fraction(world, self.view, g) for g in spec.goals),
            "attempts": self._episode.attempts,
            "task": self._episode.task.name,
            "scene_seed": spec.seed,
        }


def pose_action(grasp: Grasp, frame: Frame) -> Array:
    """Return the "pose" action (8,) of a grasp that was found in a frame.

    Raises:
        InputError: The frame's camera pose is unknown.
    """
    if frame.T_world_camera is None:
        raise InputError("a pose action is in world coordinates: T_world_camera is missing in the frame")
    T = frame.T_world_camera @ make_transform(grasp.rotation, grasp.position)
    opening = min(max(grasp.width_m, 0.0), STROKE_M)
    return np.array([*T[:3, 3], *quat_wxyz(T[:3, :3]), opening], np.float32)


def register() -> None:
    """Make the ids known to Gymnasium; calling it again changes nothing. Importing this module has done so."""
    for suite, env_id in IDS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(env_id, entry_point=f"{__name__}:{GraspingEnv.__name__}", kwargs={"suite": suite})


def _pose_space() -> spaces.Box:
    (x, y, _), high = default_workspace()
    return spaces.Box(
        np.array([x, y, 0, -1, -1, -1, -1, 0], np.float32),
        np.array([*high, 1, 1, 1, 1, STROKE_M], np.float32),
        dtype=np.float32,
    )


def _pixel_space(width: int, height: int) -> spaces.Box:
    return spaces.Box(
        np.array([0, 0, -np.pi / 2, 0], np.float32),
        np.array([width - 1, height - 1, np.pi / 2, STROKE_M], np.float32),
        dtype=np.float32,
    )


def _from_pose(action: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return T_world_tcp (4, 4) of a pose action."""
    quat = action[3:7]
    return make_transform(rotation_from_quat_wxyz(quat) if quat.any() else _top_down(0.0), action[:3])


def _top_down(angle_rad: float) -> NDArray[np.float64]:
    """Return the rotation (3, 3) of a grasp from straight above that closes at an angle from the world's x axis."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])


def _not_executed(reason: str) -> Attempt:
    return Attempt(Outcome(False, reason), Truth(None, None), ())


def _check(what: str, value: object, allowed: Sequence[object]) -> None:
    if value not in allowed:
        raise ConfigError(f"no {what} {value!r}; allowed are {', '.join(map(str, allowed))}")


register()
