"""The two ROS packages are whole: files, names, dependencies and parameters agree with one another and the page."""

from __future__ import annotations

import ast
import re
import xml.etree.ElementTree as ET
from dataclasses import fields

import numpy as np
import pytest
import yaml
from fakes.ros import INTERFACES, PACKAGE, ROOT, Strict, interface_parts, parameters
from thinkgrasp_ros.parameters import CameraParameters, Parameters

from thinkgrasp import __version__
from thinkgrasp.errors import ConfigError

MODULES = sorted((PACKAGE / "thinkgrasp_ros").glob("*.py"))
PAGE = ROOT / "docs" / "ros2.md"
ROS = ("rclpy", "tf2_ros", "message_filters", "moveit_msgs", "control_msgs", "sensor_msgs", "thinkgrasp_interfaces")


def imports(path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.split(".")[0])
    return found


def xml(package) -> ET.Element:
    return ET.parse(package / "package.xml").getroot()


@pytest.mark.parametrize("path", [*MODULES, PACKAGE / "setup.py", *PACKAGE.glob("launch/*.py")], ids=lambda p: p.name)
def test_every_file_compiles_and_says_what_it_holds(path):
    tree = ast.parse(path.read_text(), str(path))
    compile(tree, str(path), "exec")
    assert ast.get_docstring(tree)
    assert len(path.read_text().splitlines()) <= 400


def test_only_the_node_imports_ros():
    for path in MODULES:
        assert bool(imports(path) & set(ROS)) == (path.name == "node.py"), path.name


def test_whatever_is_imported_is_depended_on():
    used = set().union(*(imports(p) for p in [*MODULES, *PACKAGE.glob("launch/*.py")]))
    made = set(re.findall(r'"(\w+_msgs)/(?:msg|action)/', "".join(p.read_text() for p in MODULES)))
    depends = {e.text for e in xml(PACKAGE).findall("exec_depend")}
    known = set(ROS) | {"launch", "launch_ros", "rcl_interfaces", "shape_msgs", "geometry_msgs", "ament_index_python"}
    assert (used | made) & known <= depends
    unused = depends - used - made
    assert not unused, "depended on and not used"


def test_versions_and_names_agree():
    for package in (PACKAGE, INTERFACES):
        root = xml(package)
        assert root.get("format") == "3"
        assert root.findtext("name") == package.name
        assert root.findtext("version") == __version__
        assert root.findtext("license") == "Apache-2.0"
        assert re.match(r".+@.+", root.find("maintainer").get("email"))  # type: ignore[union-attr, arg-type]
    assert xml(PACKAGE).findtext("export/build_type") == "ament_python"
    assert xml(INTERFACES).findtext("export/build_type") == "ament_cmake"
    assert xml(INTERFACES).findtext("member_of_group") == "rosidl_interface_packages"


def test_setup_installs_what_is_there():
    told: dict[str, object] = {}
    source = (PACKAGE / "setup.py").read_text().replace("from setuptools import setup", "")
    exec(compile(source, "setup.py", "exec"), {"setup": lambda **kw: told.update(kw)})
    assert (told["name"], told["version"]) == ("thinkgrasp_ros", __version__)
    for _, files in told["data_files"]:  # type: ignore[attr-defined]
        for name in files:
            assert (PACKAGE / name).is_file(), name
    listed = {name for _, files in told["data_files"] for name in files}  # type: ignore[attr-defined]
    assert {f"config/{p.name}" for p in PACKAGE.glob("config/*")} <= listed
    assert {f"launch/{p.name}" for p in PACKAGE.glob("launch/*.py")} <= listed
    (script,) = told["entry_points"]["console_scripts"]  # type: ignore[index]
    assert script == "thinkgrasp_node = thinkgrasp_ros.node:main"
    functions = [
        n.name for n in ast.parse((PACKAGE / "thinkgrasp_ros" / "node.py").read_text()).body if hasattr(n, "name")
    ]
    assert "main" in functions
    assert "$base/lib/thinkgrasp_ros" in (PACKAGE / "setup.cfg").read_text()
    assert (PACKAGE / "resource" / "thinkgrasp_ros").is_file()


def test_the_launch_file_starts_what_setup_installs():
    text = (PACKAGE / "launch" / "thinkgrasp.launch.py").read_text()
    for wanted in ('package="thinkgrasp_ros"', 'executable="thinkgrasp_node"', 'name="thinkgrasp"', "thinkgrasp.yaml"):
        assert wanted in text


def test_cmake_builds_every_interface_and_what_they_use():
    text = (INTERFACES / "CMakeLists.txt").read_text()
    files = sorted(
        str(p.relative_to(INTERFACES)) for kind in ("msg", "srv", "action") for p in INTERFACES.glob(f"{kind}/*")
    )
    assert sorted(re.findall(r'"((?:msg|srv|action)/\w+\.\w+)"', text)) == files
    used = {m for t in interface_parts().values() for m in re.findall(r"^(\w+)/\w+(?:\[\])? ", t, re.MULTILINE)}
    used -= {"thinkgrasp_interfaces"}
    listed = set(re.search(r"DEPENDENCIES ([\w ]+)", text)[1].split())  # type: ignore[index]
    assert used == listed
    depends = {e.text for e in xml(INTERFACES).findall("depend")}
    assert used | {"action_msgs"} == depends, "actions need action_msgs"


@pytest.mark.parametrize("name", sorted(interface_parts()))
def test_interfaces_are_messages(name):
    message = Strict(name)
    assert message.bytes()
    assert all(re.fullmatch(r"[a-z](_?[a-z0-9]+)*", field) for field in message._fields), "names as rosidl wants them"


def test_the_statuses_are_those_of_a_decision_and_the_ends_those_of_the_loop():
    from typing import get_args

    from thinkgrasp.loop import End
    from thinkgrasp.types import Status

    response = Strict("thinkgrasp_interfaces/srv/FindGrasp_Response")
    assert {response.GRASP, response.NO_TARGET, response.NO_GRASP} == set(get_args(Status))
    text = (INTERFACES / "action" / "ClearAndGrasp.action").read_text()
    for end in get_args(End):
        assert end in text


def config() -> dict[str, object]:
    told = yaml.safe_load((PACKAGE / "config" / "thinkgrasp.yaml").read_text())
    flat: dict[str, object] = {}
    for key, value in told["thinkgrasp"]["ros__parameters"].items():
        flat |= {f"{key}.{k}": v for k, v in value.items()} if isinstance(value, dict) else {key: value}
    return flat


def test_the_file_of_parameters_is_taken():
    told = config()
    asked: list[str] = []

    def lookup(name, default):
        asked.append(name)
        return told.get(name, default)

    read = Parameters.read(lookup)
    assert set(told) <= set(asked), "the file names parameters that there are not"
    assert read.camera_parameters[0].depth_topic == "/camera/camera/aligned_depth_to_color/image_raw"
    assert read.planner == "RRTstar"
    planners = yaml.safe_load((PACKAGE / "config" / "ompl_rrtstar.yaml").read_text())
    assert planners["planner_configs"][read.planner]["type"] == "geometric::RRTstar"
    assert read.planner in planners[read.group]["planner_configs"]


def test_the_page_has_every_parameter_with_its_default():
    page = PAGE.read_text().partition("## Parameters")[2]
    rows = dict(re.findall(r"^\| `([\w<>.]+)` \| (.*?) \|", page, re.MULTILINE))
    names = {f.name: f.default for f in fields(Parameters) if f.metadata.get("declared", True)}
    camera = {f"<camera>.{f.name}" for f in fields(CameraParameters) if f.name != "name"}
    assert set(rows) == set(names) | camera
    for name, default in names.items():
        said = rows[name].strip("`")
        written = list(default) if isinstance(default, tuple) else default
        assert said == ("empty" if written == [] else str(written).replace("'", "")), name


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"velocity_scale": 0.0}, r"velocity_scale must lie in \(0, 1\]"),
        ({"acceleration_scale": 1.5}, "acceleration_scale must lie"),
        ({"standoff_m": float("nan")}, "standoff_m must be positive"),
        ({"motion_timeout_s": 0.0}, "motion_timeout_s must be positive"),
        ({"obstacle_m": -0.1}, "obstacle_m must be at least 0"),
        ({"step_limit": 0}, "step_limit must be at least 1"),
        ({"planner": ""}, "planner must not be empty"),
        ({"cameras": ()}, "name each camera once"),
        ({"cameras": ("a", "a")}, "name each camera once"),
        ({"gripper_open": 0.8}, "are both 0.8"),
        ({"gripper_closed": float("nan")}, "gripper_closed must be finite"),
        ({"held_margin": 1.0}, "held_margin must be less than 1"),
        ({"workspace": (0.0, 1.0)}, "workspace must be 6 finite numbers"),
        ({"workspace": (0.0, 0.0, 0.0, -1.0, 1.0, 1.0)}, "its lowest corner, then its highest"),
        ({"tcp_offset": (0.0,) * 7}, "unit quaternion"),
        ({"place_joints": (0.0,) * 5}, "place_joints must be 6 finite angles"),
        ({"home_joints": (float("inf"),) * 6}, "home_joints must be 6 finite angles"),
    ],
)
def test_parameters_out_of_range_are_named(change, said):
    with pytest.raises(ConfigError, match=said):
        parameters(**change)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("step_limit", "3", "parameter step_limit must be a int, got '3'"),
        ("planner", 3, "parameter planner must be a str, got 3"),
        ("velocity_scale", True, "parameter velocity_scale must be a float, got True"),
        ("joint_names", "a", "parameter joint_names must be a list, got 'a'"),
        ("joint_names", [1, 2], "parameter joint_names must be a list of names, got 1 among them"),
        ("cameras", [""], "parameter cameras must be a list of names, got '' among them"),
        ("workspace", [0, 0, 0, 1, 1, "1"], "parameter workspace must be a list of numbers, got '1' among them"),
        ("home_joints", [True], "parameter home_joints must be a list of numbers, got True among them"),
        ("camera.rectified", "yes", "parameter camera.rectified must be a bool, got 'yes'"),
        ("camera.depth_topic", 3, "parameter camera.depth_topic must be a str, got 3"),
    ],
)
def test_parameters_of_another_type_are_named(name, value, said):
    with pytest.raises(ConfigError, match=said):
        Parameters.read(lambda key, default: value if key == name else default)


def test_whole_numbers_pass_for_fractions_and_arrays_for_lists():
    told = {"velocity_scale": 1, "workspace": np.array([0.0, 0, 0, 1, 1, 1])}
    read = Parameters.read(lambda key, default: told.get(key, default))
    assert read.velocity_scale == 1.0
    assert len(read.workspace) == 6


def test_the_gripper_is_closed_near_its_end_whichever_way_it_counts():
    for low, high in ((0.0, 0.8), (0.085, 0.0)):
        told = parameters(gripper_open=low, gripper_closed=high)
        assert told.is_closed(high)
        assert told.is_closed(told.gripper_position(0.001))
        assert not told.is_closed(told.gripper_position(0.01))
        assert told.gripper_position(0.085) == pytest.approx(low)
