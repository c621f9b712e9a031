"""The Gymnasium environments: their contract, seeds, actions, rewards and ends."""

from __future__ import annotations

import subprocess
import sys
from functools import cache

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="needs thinkgrasp[sim]")
pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from gymnasium.utils.env_checker import check_env, data_equivalence  # noqa: E402

from thinkgrasp.environment import IDS, LOWEST_TIP_M, PIXEL_DEPTH_M, GraspingEnv, pose_action, register  # noqa: E402
from thinkgrasp.errors import ConfigError, InputError  # noqa: E402
from thinkgrasp.geometry import apply, invert, make_transform, rotation_from_quat_wxyz  # noqa: E402
from thinkgrasp.memory import Memory  # noqa: E402
from thinkgrasp.motion.robotiq_2f85 import STROKE_M  # noqa: E402
from thinkgrasp.sim import scenes  # noqa: E402
from thinkgrasp.sim.tasks import Task  # noqa: E402
from thinkgrasp.types import Grasp  # noqa: E402

TABLE_POSE = np.array([0.4, 0.0, 0.25, 0, 0, 0, 0, 0.05], np.float32)
"""Closes in the air above the piles."""


@cache
def two_things(instruction: str, seed: int) -> scenes.PiledScene:
    return scenes.clutter(instruction, seed, n_objects=2, visibility="visible", pool="all")


@pytest.fixture
def small_piles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two visible objects instead of whole piles: a heavy pile takes seconds."""
    monkeypatch.setattr(Task, "scene", lambda task, seed, visibility=None: two_things(task.instruction, seed))


def make(env_id: str = IDS["clutter"], **kwargs: object) -> GraspingEnv:
    env = gymnasium.make(env_id, **kwargs).unwrapped
    assert isinstance(env, GraspingEnv)
    return env


def goal_pixel(env: GraspingEnv) -> tuple[int, int]:
    """Column and row of the pixel that shows the middle of the first goal's upper side."""
    session = env.session
    center = session.world.center(session.goals[0])
    u, v = env.view.intrinsics.project(apply(invert(env.view.T_world_camera), center))
    return round(u), round(v)


@pytest.mark.parametrize("env_id", IDS.values())
@pytest.mark.parametrize("action", ["pose", "pixel"])
@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space:UserWarning")  # actions are in metres and pixels
def test_passes_gymnasiums_own_check(env_id, action, small_piles):
    check_env(make(env_id, action=action))


def test_registering_again_changes_nothing():
    before = dict(gymnasium.registry)
    register()
    assert gymnasium.registry == before


def test_found_without_importing_the_module():
    code = "import gymnasium; print(gymnasium.make('thinkgrasp.environment:ThinkGrasp/Heavy-v1').unwrapped.step_limit)"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "50", done.stderr


def test_without_gymnasium_says_what_to_install():
    code = (
        "import sys; sys.modules['gymnasium'] = None\n"
        "from thinkgrasp.errors import MissingDependency\n"
        "try:\n    import thinkgrasp.environment\n"
        "except MissingDependency as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "'gymnasium'" in done.stdout, done.stderr
    assert "pip install 'thinkgrasp[sim]'" in done.stdout


def test_same_seed_and_actions_same_episode():
    runs = []
    for _ in range(2):
        env = make()
        env.action_space.seed(3)
        run = [env.reset(seed=11)]
        run += [env.step(env.action_space.sample()) for _ in range(3)]
        run.append(env.reset())
        runs.append(run)
    assert data_equivalence(*runs, exact=True)
    first, second = runs[0][0][1], runs[0][-1][1]
    assert (first["task"], first["scene_seed"]) != (second["task"], second["scene_seed"])


def test_info_makes_the_same_pile_again():
    env = make()
    seen, info = env.reset(seed=5)
    env.reset()
    again, info_again = env.reset(options={"task": info["task"], "scene_seed": info["scene_seed"]})
    assert data_equivalence(seen, again, exact=True)
    assert info == info_again
    assert info["outcome"] is None
    assert info["attempts"] == 0
    assert len(info["goals"]) == len(info["visible"]) >= 1


def test_a_seed_without_a_pile_is_passed_over(monkeypatch):
    asked: list[int] = []

    def scene(task: Task, seed: int, visibility: scenes.Visibility | None = None) -> scenes.PiledScene:
        asked.append(seed)
        if len(asked) < 3:
            raise InputError("no pile came out")
        return two_things(task.instruction, seed)

    monkeypatch.setattr(Task, "scene", scene)
    _, info = make().reset(seed=0)
    assert info["scene_seed"] == asked[2]
    assert len(set(asked)) == 3
    asked.clear()
    with pytest.raises(InputError, match="no pile"):
        make().reset(options={"scene_seed": 4})
    assert asked == [4]


def test_goal_as_hidden_as_asked_for():
    _, info = make().reset(seed=0, options={"task": "pear", "visibility": "partly"})
    low, high = scenes.VISIBLE_SHARE["partly"]
    assert low - 0.02 <= info["visible"][0] <= high + 0.02


def test_heavy_pile():
    env = make(IDS["heavy"])
    observation, info = env.reset(seed=0, options={"task": "heavy-01-round_hard", "scene_seed": 1})
    assert observation["instruction"] == "grasp a ball"
    assert 20 <= len(env.session.world.objects) <= 30
    assert info["visible"][0] <= scenes.VISIBLE_SHARE["hidden"][1] + 0.02


def test_a_grasp_from_above_delivers_the_goal(small_piles):
    env = make(action="pixel")
    env.reset(seed=0, options={"task": "pear", "scene_seed": 1})
    u, v = goal_pixel(env)
    for degrees in (0, 45, 90, -45):
        _, reward, terminated, truncated, info = env.step(np.array([u, v, np.radians(degrees), STROKE_M], np.float32))
        if terminated:
            break
        assert reward == 0.0
        u, v = goal_pixel(env)
    assert (reward, terminated, truncated) == (1.0, True, False)
    assert info["outcome"] == "held"
    assert info["grasped"] == info["delivered"] == info["goals"][0] == "pear"
    assert info["visible"] == (0.0,)


def test_the_oracles_grasp_delivers_the_goal(small_piles):
    env = make()
    observation, _ = env.reset(seed=0, options={"task": "pear", "scene_seed": 1})
    decision = env.session.pipeline("oracle").decide(env.frame, observation["instruction"], Memory())
    _, reward, terminated, _, info = env.step(pose_action(decision.grasp, env.frame))
    assert (reward, terminated, info["delivered"]) == (1.0, True, "pear")


def test_pose_action_is_the_grasp_in_the_world(small_piles):
    env = make()
    env.reset(seed=0)
    R = rotation_from_quat_wxyz(np.array([0.5, 0.5, -0.1, 0.7]))
    grasp = Grasp(R, np.array([0.01, -0.02, 0.5]), width_m=0.2, score=0.5)
    action = pose_action(grasp, env.frame)
    T_world_camera = env.frame.T_world_camera
    assert T_world_camera is not None
    T = make_transform(rotation_from_quat_wxyz(action[3:7]), action[:3])
    np.testing.assert_allclose(T, T_world_camera @ make_transform(R, grasp.position), atol=1e-6)
    assert action[7] == np.float32(STROKE_M)


def executed(env: GraspingEnv, action: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> tuple[np.ndarray, float]:
    """T_world_tcp and opening of what the robot is asked to do."""
    asked: list[Grasp] = []
    inner = env.session.robot.robot
    execute = inner.execute
    monkeypatch.setattr(inner, "execute", lambda grasp, frame: asked.append(grasp) or execute(grasp, frame))
    env.step(action)
    (grasp,) = asked
    return env.view.T_world_camera @ make_transform(grasp.rotation, grasp.position), grasp.width_m


def test_zero_quaternion_comes_from_straight_above(small_piles, monkeypatch):
    env = make()
    env.reset(seed=0)
    T, opening = executed(env, TABLE_POSE, monkeypatch)
    np.testing.assert_allclose(T[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-9)
    np.testing.assert_allclose(T[:3, 3], TABLE_POSE[:3], atol=1e-7)
    assert opening == pytest.approx(0.05)


def test_pixel_goes_below_the_surface_and_not_into_the_table(small_piles, monkeypatch):
    env = make(action="pixel", noise=False)
    env.reset(seed=0, options={"task": "pear", "scene_seed": 1})
    u, v = goal_pixel(env)
    point = env.view.eye + env.frame.depth[v, u] * env.view.rays[v * env.view.intrinsics.width + u]
    angle = np.float32(0.6)
    T, _ = executed(env, np.array([u, v, angle, STROKE_M], np.float32), monkeypatch)
    np.testing.assert_allclose(T[:2, 3], point[:2], atol=1e-6)
    assert T[2, 3] == pytest.approx(max(point[2] - PIXEL_DEPTH_M, LOWEST_TIP_M), abs=1e-6)
    np.testing.assert_allclose(T[:3, 0], [np.cos(angle), np.sin(angle), 0], atol=1e-6)
    np.testing.assert_allclose(T[:3, 2], [0, 0, -1], atol=1e-9)


def test_what_cannot_be_executed_is_a_failed_attempt(small_piles):
    env = make(action="pixel")
    env.reset(seed=0)
    u, v = goal_pixel(env)
    assert env.frame.workspace is not None
    hole = np.array([u, v, 0, STROKE_M], np.float32)
    env.frame.depth[v, u] = 0.0
    row, column = np.argwhere(~env.frame.workspace & (env.frame.depth > 0))[0]
    outside = np.array([column, row, 0, STROKE_M], np.float32)
    for count, (action, reason) in enumerate(
        [
            (hole, "no_depth"),
            (outside, "outside_workspace"),
            (np.array([np.nan, 0, 0, 0.05]), "invalid_action"),
            (np.array([-1, 0, 0, 0.05]), "invalid_action"),
        ],
        start=1,
    ):
        _, reward, terminated, truncated, info = env.step(action)
        assert (info["outcome"], reward, terminated, truncated) == (reason, 0.0, False, False)
        assert (info["attempts"], info["grasped"], info["delivered"]) == (count, None, None)
    with pytest.raises(InputError, match=r"pixel action has the shape \(4,\), got \(8,\)"):
        env.step(TABLE_POSE)


def test_a_pose_out_of_reach_is_a_failed_attempt(small_piles):
    env = make()
    env.reset(seed=0)
    pointing_up_out_of_the_table = np.array([0.5, 0, 0.0, 1, 0, 0, 0, 0.05], np.float32)
    info = env.step(pointing_up_out_of_the_table)[-1]
    assert (info["outcome"], info["attempts"]) == ("unreachable", 1)


@pytest.mark.parametrize(("env_id", "limit"), [(IDS["clutter"], 15), (IDS["heavy"], 50)])
def test_step_limit_truncates(env_id, limit, small_piles):
    env = make(env_id, noise=False)
    env.reset(seed=0)
    nothing = np.full(8, np.nan, np.float32)
    ends = [env.step(nothing)[2:4] for _ in range(limit)]
    assert ends == [(False, False)] * (limit - 1) + [(False, True)]
    assert env.reset()[1]["attempts"] == 0


def test_an_empty_table_truncates(small_piles):
    env = make()
    env.reset(seed=0)
    for index in range(len(env.session.world.objects)):
        env.session.world.park(index)
    assert env.step(TABLE_POSE)[2:4] == (False, True)


def test_film(small_piles):
    env = make(render_mode="rgb_array")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.render()
    env.reset(seed=0)
    picture = env.render()
    assert picture is not None
    assert (picture.shape, picture.dtype) == ((240, 320, 3), np.uint8)
    assert picture.std() > 10
    assert make().render() is None


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"taks": "pear"}, "unknown option of reset: taks; allowed are task, visibility, scene_seed"),
        ({"task": "paer"}, "Did you mean 'pear'"),
        ({"task": "heavy-04-fruit"}, "is no task of ThinkGrasp/Clutter-v1; its tasks are clutter-00-round"),
        ({"visibility": "gone"}, "no visibility 'gone'; allowed are visible, partly, hidden"),
        ({"scene_seed": 0.5}, "scene_seed must be a whole number, got 0.5"),
        ({"scene_seed": -1}, "a seed must not be negative"),
    ],
)
def test_wrong_options(options, says):
    with pytest.raises(ConfigError, match=says):
        make().reset(seed=0, options=options)


@pytest.mark.parametrize(
    "kwargs",
    [{"suite": "tidy"}, {"action": "joints"}, {"camera": "kinect"}, {"size_wh": (1, 1)}, {"render_mode": "human"}],
)
def test_wrong_settings(kwargs):
    with pytest.raises(ConfigError, match="allowed are"):
        GraspingEnv(**kwargs)


def test_size_and_space_of_another_camera(small_piles):
    env = make(camera="d455", size_wh=(320, 240), noise=False, action="pixel")
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    assert observation["color"].shape == (240, 320, 3)
    assert env.action_space.high[:2].tolist() == [319, 239]
