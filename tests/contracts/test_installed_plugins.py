"""Every plug-in that is registered, ours or another package's, keeps its contract."""

from __future__ import annotations

import socket
from importlib.metadata import EntryPoint

import pytest
from fakes.chat_server import dead_url
from fakes.models import model
from fakes.networks import untrained_vgn

from thinkgrasp import registry, testing
from thinkgrasp.cameras.saving import save_frame
from thinkgrasp.episode import EpisodeHeader
from thinkgrasp.gripper import GRIPPERS

STAGES = {
    "scene": testing.check_scene,
    "planner": testing.check_planner,
    "segmenter": testing.check_segmenter,
    "generator": testing.check_generator,
    "check": testing.check_check,
}


def registered(kind: registry.Kind) -> list[str]:
    return list(registry.available(kind))


ASKS_A_SERVER = ("planner", "openai")
VLPART = ("segmenter", "vlpart")
NEEDS_VGN = (("generator", "vgn"), ("generator", "vgn_antipodal"))
CLOUD_NETWORKS = {("generator", "graspnet"): "graspnet", ("generator", "fgc_graspnet"): "fgc"}
NEEDS_WEIGHTS = {("segmenter", name) for name in ("grounded_sam", "sam3", "cascade")}
SPECIAL = {ASKS_A_SERVER, VLPART, *NEEDS_VGN, *CLOUD_NETWORKS, *NEEDS_WEIGHTS}


@pytest.mark.parametrize(("kind", "name"), [(k, n) for k in STAGES for n in registered(k) if (k, n) not in SPECIAL])
def test_stage_keeps_its_contract(kind, name):
    STAGES[kind](registry.load(kind, name))


@pytest.mark.parametrize("name", ["grounded_sam", "sam3", "cascade"])
def test_segmenter_with_random_weights_keeps_its_contract(name):
    pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")
    pair = {"detector": model("grounding_dino"), "masks": model("sam"), "refine_marks": True, "device": "cpu"}
    settings = {
        "grounded_sam": pair,
        "sam3": {"model": model("sam3"), "score_threshold": 0.3, "device": "cpu"},
        "cascade": {"objects": {"name": "grounded_sam", "settings": pair}, "parts": None},
    }
    testing.check_segmenter(registry.load("segmenter", name, **settings[name]))


def test_planner_without_its_server_keeps_its_contract():
    pytest.importorskip("openai", reason="needs thinkgrasp[vlm]")
    planner = registry.load(*ASKS_A_SERVER, base_url=dead_url(), retries=0)
    testing.check_planner(planner, deterministic=False)
    planner.close()


def test_segmenter_of_parts_with_random_weights_keeps_its_contract(tmp_path):
    pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")
    from fakes.vlpart import TINY, save_checkpoint

    weights, tokenizer = save_checkpoint(tmp_path)
    settings = {"weights": weights, "tokenizer": tokenizer, "config": TINY, "cache_folder": tmp_path / "cache"}
    testing.check_segmenter(registry.load(*VLPART, **settings, device="cpu"))


@pytest.mark.parametrize("point", NEEDS_VGN, ids=lambda p: p[1])
def test_generator_with_an_untrained_network_keeps_its_contract(point, tmp_path):
    pytest.importorskip("torch", reason="needs thinkgrasp[graspnet]")
    settings = {"threshold": 0.3, "variant": "devel", "n_yaws": 1}  # an untrained network calls everything 0.5
    generator = registry.load(
        *point, weights=untrained_vgn(tmp_path), **(settings if point[1] == "vgn" else {"vgn": settings})
    )  # fmt: skip
    testing.check_generator(generator)


@pytest.mark.parametrize(("kind", "name"), CLOUD_NETWORKS)
def test_generator_with_random_weights_keeps_its_contract(kind, name, tmp_path):
    pytest.importorskip("torch", reason="needs thinkgrasp[graspnet]")
    from fakes.grasp_networks import random_weights, save

    weights = save(tmp_path / "weights.tar", random_weights(CLOUD_NETWORKS[kind, name]))
    testing.check_generator(registry.load(kind, name, weights=weights, device="cpu", num_point=2048))


def test_file_camera_keeps_its_contract(tmp_path):
    color, depth, camera = save_frame(testing.sample_frame(), tmp_path)
    testing.check_camera(registry.load("camera", "files", color=color, depth=depth, camera=camera))


GRIPPER = GRIPPERS["robotiq_2f85"]


def empty_cell() -> object:
    pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
    from thinkgrasp.sim.world import World

    return World([])


def test_simulated_camera_keeps_its_contract():
    testing.check_camera(registry.load("camera", "simulated", world=empty_cell()))


def test_simulated_robot_keeps_its_contract():
    testing.check_robot(registry.load("robot", "simulated", world=empty_cell()))


def test_episode_recorder_keeps_its_contract(tmp_path):
    header = EpisodeHeader(instruction="the red box", goal="", preset="offline", seed=0)
    testing.check_recorder(registry.load("recorder", "episode", folder=tmp_path, header=header, gripper=GRIPPER))


def test_live_view_keeps_its_contract():
    pytest.importorskip("viser", reason="needs thinkgrasp[viz]")
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    view = registry.load("recorder", "live", gripper=GRIPPER, port=port)
    try:
        testing.check_recorder(view)
    finally:
        view.close()


def test_nothing_is_left_out():
    tested = {"camera": {"files", "simulated"}, "robot": {"simulated"}, "recorder": {"episode", "live"}}
    tested["camera"].add("realsense")  # tests/cameras/test_realsense.py, over a fake of the vendor's module
    tested["robot"].add("ur")  # tests/robots/test_ur_rtde.py
    for kind in set(registry.KINDS) - set(STAGES):
        assert set(registered(kind)) <= tested[kind], "a plug-in has no contract test here"


def test_each_preset_names_registered_plugins():
    from thinkgrasp.config import PRESETS, STAGES

    for config in PRESETS.values():
        for kind in STAGES:
            stage = getattr(config, kind)
            assert stage is None or isinstance(registry.available(kind)[stage.name], EntryPoint)
        assert {c.name for c in config.checks} <= set(registry.available("check"))
