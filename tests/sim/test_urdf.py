"""Objects from a folder: what is read, and what is refused with the file and the line."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from trimesh import Trimesh

trimesh = pytest.importorskip("trimesh", reason="reading meshes needs trimesh")

from thinkgrasp.errors import InputError  # noqa: E402
from thinkgrasp.sim import meshes  # noqa: E402
from thinkgrasp.sim.objects import SimObject  # noqa: E402
from thinkgrasp.sim.urdf import load_object, load_objects  # noqa: E402

YCB = Path(__file__).parents[3] / "shared" / "objects_ycb"

BOX = """\
<?xml version="1.0"?>
<robot name="box">
  <link name="base">
    <inertial><mass value="0.2"/></inertial>
    <visual><geometry><box size="0.08 0.06 0.04"/></geometry>
      <material name="paint"><color rgba="0.8 0.1 0.1 1"/></material></visual>
    <collision><geometry><box size="0.08 0.06 0.04"/></geometry></collision>
  </link>
</robot>
"""
"""Line 4 holds the mass, 5 the visual's shape, 6 the material, 7 the collision."""


def folder(tmp_path: Path, urdf: str = BOX, toml: str | None = None, name: str = "red_box") -> Path:
    place = tmp_path / name
    place.mkdir(parents=True)
    (place / "model.urdf").write_text(urdf)
    if toml is not None:
        (place / "object.toml").write_text(toml)
    return place


def with_mesh(tmp_path: Path, mesh: Trimesh, scale: str = "1 1 1", ending: str = "obj") -> Path:
    shape = f'<mesh filename="shape.{ending}" scale="{scale}"/>'
    place = folder(tmp_path, BOX.replace('<box size="0.08 0.06 0.04"/>', shape))
    mesh.export(place / f"shape.{ending}")
    return place


def points_of(obj: SimObject) -> list[np.ndarray]:
    """Corners (P, 3) of every collision piece, all of which are hulls."""
    return [p.points_m for p in obj.collisions if p.shape == "hull" and p.points_m is not None]


def angle_iron() -> Trimesh:
    """An L of 8 cm by 8 cm, 2 cm thick and 3 cm deep."""
    corners = np.array([[0, 0], [0.08, 0], [0.08, 0.02], [0.02, 0.02], [0.02, 0.08], [0, 0.08]])
    n = len(corners)
    front = np.column_stack([corners, np.zeros(n)])
    back = np.column_stack([corners, np.full(n, 0.03)])
    cap = np.array([[0, 1, 3], [1, 2, 3], [0, 3, 5], [3, 4, 5]])
    i, j = np.arange(n), (np.arange(n) + 1) % n
    sides = np.concatenate([np.stack([i, j, j + n], 1), np.stack([i, j + n, i + n], 1)])
    return trimesh.Trimesh(np.concatenate([front, back]), np.concatenate([cap[:, ::-1], cap + n, sides]))


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "thinkgrasp" / "convex"


def test_a_box_without_description_is_described_by_its_folder_and_material(tmp_path):
    obj = load_object(folder(tmp_path))
    assert (obj.name, obj.colors, obj.mass_kg, obj.friction) == ("red box", ("red",), 0.2, 0.6)
    assert np.allclose(obj.bounds_m, [[-0.04, -0.03, -0.02], [0.04, 0.03, 0.02]])
    assert (obj.collisions[0].shape, obj.collisions[0].size_m) == ("box", (0.04, 0.03, 0.02))
    assert obj.source == str(tmp_path / "red_box")


@pytest.mark.parametrize(
    ("name", "said"), [("YcbTomatoSoupCan", "ycb tomato soup can"), ("mug_2", "mug 2"), ("USBStick", "usb stick")]
)
def test_the_folder_gives_the_name(tmp_path, name, said):
    assert load_object(folder(tmp_path, name=name)).name == said


def test_a_known_name_brings_its_category_and_uses(tmp_path):
    obj = load_object(folder(tmp_path, toml='name = "mug"\n'))
    assert obj.category == "drinkware"
    assert "hold" in obj.uses


def test_the_description_overrides(tmp_path):
    toml = 'name = "Pen  Pot"\ncategory = "container"\ncolors = ["blue", "white"]\nuses = ["hold"]\n'
    obj = load_object(folder(tmp_path, toml=toml))
    assert (obj.name, obj.category, obj.colors, obj.uses) == ("pen pot", "container", ("blue", "white"), ("hold",))


@pytest.mark.parametrize(
    ("shape", "kind", "size", "bounds"),
    [
        ('<box size="0.1 0.04 0.02"/>', "box", (0.05, 0.02, 0.01), (0.05, 0.02, 0.01)),
        ('<sphere radius="0.03"/>', "sphere", (0.03,), (0.03, 0.03, 0.03)),
        ('<cylinder radius="0.03" length="0.1"/>', "cylinder", (0.03, 0.05), (0.03, 0.03, 0.05)),
    ],
)
def test_primitives_are_closed_face_outwards_and_collide_as_themselves(tmp_path, shape, kind, size, bounds):
    obj = load_object(folder(tmp_path, BOX.replace('<box size="0.08 0.06 0.04"/>', shape)))
    assert obj.collisions[0].shape == kind
    assert np.allclose(obj.collisions[0].size_m, size)
    assert np.allclose(obj.bounds_m[1], bounds, atol=1e-4)
    seen = trimesh.Trimesh(obj.visuals[0].vertices, obj.visuals[0].faces)
    assert seen.is_watertight
    assert seen.volume > 0


def test_origins_use_fixed_axes_and_the_frame_moves_to_the_middle(tmp_path):
    origin = '<origin xyz="0.1 0.2 0.3" rpy="0.3 -0.5 1.2"/>'
    urdf = BOX.replace("<visual>", f"<visual>{origin}").replace("<collision>", f"<collision>{origin}")
    obj = load_object(folder(tmp_path, urdf))
    R = Rotation.from_euler("z", 1.2) * Rotation.from_euler("y", -0.5) * Rotation.from_euler("x", 0.3)
    piece = obj.collisions[0]
    assert np.allclose(Rotation.from_quat(piece.quat_wxyz, scalar_first=True).as_matrix(), R.as_matrix())
    assert np.allclose(piece.position_m, 0, atol=1e-7)
    assert np.allclose(obj.bounds_m.mean(axis=0), 0, atol=1e-7)


def test_fixed_joints_merge_links(tmp_path):
    handle = """
  <link name="handle"><inertial><mass value="0.05"/></inertial>
    <visual name="grip"><geometry><sphere radius="0.01"/></geometry><material name="paint"/></visual>
    <collision><geometry><sphere radius="0.01"/></geometry></collision></link>
  <joint name="j" type="fixed"><parent link="base"/><child link="handle"/><origin xyz="0.05 0 0"/></joint>
  <material name="paint"><color rgba="0 0 1 1"/></material>
</robot>"""
    obj = load_object(folder(tmp_path, BOX.replace("</robot>", handle)))
    assert obj.parts == ("base/body", "handle/grip")
    assert obj.mass_kg == pytest.approx(0.25)
    assert (obj.visuals[1].color, obj.colors) == ((0, 0, 1), ("red", "blue"))
    apart = np.subtract(obj.collisions[1].position_m, obj.collisions[0].position_m)
    assert np.allclose(apart, [0.05, 0, 0])


@pytest.mark.parametrize("ending", ["obj", "stl", "ply"])
def test_mesh_formats_and_scale(tmp_path, ending):
    obj = load_object(with_mesh(tmp_path, trimesh.creation.box((80, 60, 40)), "0.001 0.001 0.001", ending))
    assert np.allclose(obj.bounds_m[1], [0.04, 0.03, 0.02])
    assert points_of(obj)[0].shape == (8, 3)


def test_a_mirroring_scale_keeps_faces_outwards(tmp_path):
    visual = load_object(with_mesh(tmp_path, angle_iron(), "-1 1 1")).visuals[0]
    assert trimesh.Trimesh(visual.vertices, visual.faces).volume > 0


def test_every_group_of_an_obj_is_a_piece_of_few_points(tmp_path):
    place = with_mesh(tmp_path, trimesh.creation.icosphere(subdivisions=3, radius=0.03))
    one = (place / "shape.obj").read_text()
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    faces = "\n".join("f {} {} {}".format(*(f + 1 + len(sphere.vertices))) for f in sphere.faces)
    vertices = "\n".join("v {} {} {}".format(*(v + np.array([0.05, 0, 0]))) for v in sphere.vertices)
    first = "\n".join(line for line in one.splitlines() if line.startswith(("v ", "f ")))
    (place / "shape.obj").write_text(f"o a\n{first}\no b\n{vertices}\n{faces}\n")
    hulls = points_of(load_object(place))
    assert len(hulls) == 2
    for hull in hulls:
        assert len(hull) <= meshes.MAX_HULL_POINTS
        assert ConvexHull(hull).volume > 0.8 * sphere.volume


def test_a_hollow_mesh_is_decomposed_once(tmp_path, own_cache, monkeypatch):
    pytest.importorskip("coacd", reason="decomposing needs coacd")
    place = with_mesh(tmp_path, angle_iron())
    hulls = points_of(load_object(place))
    volumes = [ConvexHull(hull).volume for hull in hulls]
    assert len(hulls) >= 2
    assert sum(volumes) == pytest.approx(angle_iron().volume, rel=0.15)
    assert len(list(own_cache.glob("*.npz"))) == 1
    monkeypatch.setattr(meshes, "_keep", lambda *_: pytest.fail("decomposed again"))
    again = points_of(load_object(place))
    assert all(np.array_equal(a, b) for a, b in zip(hulls, again, strict=True))


def test_a_broken_cache_costs_time_only(tmp_path, own_cache):
    pytest.importorskip("coacd", reason="decomposing needs coacd")
    place = with_mesh(tmp_path, angle_iron())
    before = load_object(place).collisions
    next(own_cache.glob("*.npz")).write_bytes(b"PK\x03\x04 not an archive")
    assert len(load_object(place).collisions) == len(before)


def test_without_coacd_hollows_are_filled_and_it_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(meshes, "_installed", lambda package: package != "coacd")
    with pytest.warns(UserWarning, match=r"model\.urdf:7: shape\.obj is not convex; its hollows are filled"):
        obj = load_object(with_mesh(tmp_path, angle_iron()))
    assert len(obj.collisions) == 1


def test_stray_text_and_an_odd_version_are_let_pass(tmp_path):
    urdf = BOX.replace('version="1.0"', 'version="0.0"').replace("</inertial>", "</inertial>g")
    assert load_object(folder(tmp_path, urdf)).mass_kg == 0.2


SHAPE = '<box size="0.08 0.06 0.04"/>'
VISUAL = BOX.splitlines()[4] + "\n" + BOX.splitlines()[5]
COLLISION = BOX.splitlines()[6]
LINK2 = '<link name="b"/><joint name="j" type="{}"><parent link="{}"/><child link="b"/></joint></robot>'

BAD_URDF = {
    "not xml": (BOX.replace("</link>", ""), "9: not well-formed XML: mismatched tag"),
    "empty": ("", "1: not well-formed XML: no element found"),
    "entities": (
        BOX.replace("<robot ", "<!DOCTYPE x [<!ENTITY a 'b'>]>\n<robot "),
        "2: a document type is not allowed",
    ),
    "not a robot": ("<sdf/>", "1: a URDF starts with <robot>, found <sdf>"),
    "no link": ("<robot/>", "1: a URDF needs at least one <link>"),
    "no mass": (BOX.replace('<inertial><mass value="0.2"/></inertial>', ""), "3: link 'base' has no mass"),
    "zero mass": (BOX.replace("0.2", "0"), "4: <mass> value must be positive, got '0'"),
    "negative mass": (BOX.replace("0.2", "-1"), "4: <mass> value must be positive"),
    "grams": (BOX.replace("0.2", "200"), "2: the mass must lie in (0, 50) kg, got 200"),
    "mass in words": (BOX.replace("0.2", "light"), "4: <mass> value must be one number, got 'light'"),
    "mass without value": (BOX.replace(' value="0.2"', ""), "4: <mass> lacks value="),
    "no visual": (BOX.replace(VISUAL, "\n"), "2: no link has a <visual>"),
    "no collision": (BOX.replace(COLLISION, ""), "2: no link has a <collision>"),
    "no geometry": (BOX.replace(f"<geometry>{SHAPE}</geometry>", ""), "5: <visual> lacks a <geometry>"),
    "two shapes": (BOX.replace(SHAPE, SHAPE + SHAPE), "5: <geometry> must hold one shape, found 2"),
    "unknown shape": (BOX.replace("<box size", "<cone size"), "5: unknown geometry <cone>"),
    "two sizes": (BOX.replace("0.08 0.06 0.04", "0.08 0.06"), "5: <box> size must be 3 numbers, got '0.08 0.06'"),
    "nan": (BOX.replace("0.08 0.06 0.04", "0.08 nan 0.04"), "5: <box> size must be 3 numbers"),
    "negative size": (BOX.replace("0.08 0.06 0.04", "0.08 -0.06 0.04"), "5: <box> size must be positive"),
    "millimetres": (
        BOX.replace("0.08 0.06 0.04", "80 60 40"),
        '2: the longest side is 80 m.*scale="0.001 0.001 0.001"',
    ),
    "tiny": (BOX.replace("0.08 0.06 0.04", "0.001 0.001 0.001"), "2: the longest side is 0.001 m"),
    "no such mesh": (
        BOX.replace(SHAPE, '<mesh filename="a.obj"/>'),
        "5: mesh 'a.obj' does not exist; files in red_box/",
    ),
    "escaping mesh": (BOX.replace(SHAPE, '<mesh filename="../../etc/passwd"/>'), "5: mesh .* leads out of"),
    "absolute mesh": (BOX.replace(SHAPE, '<mesh filename="/etc/passwd"/>'), "5: mesh .* must be a path relative"),
    "package mesh": (BOX.replace(SHAPE, '<mesh filename="package://x/a.obj"/>'), "5: mesh .* must be a path relative"),
    "mesh of no kind": (
        BOX.replace(SHAPE, '<mesh filename="model.urdf"/>'),
        "5: mesh cannot be used: .*cannot read .urdf",
    ),
    "bad colour": (BOX.replace("0.8 0.1 0.1 1", "200 30 30 255"), "6: <color> rgba must lie in 0 to 1"),
    "unknown material": (
        BOX.replace('<color rgba="0.8 0.1 0.1 1"/>', ""),
        "6: material 'paint' has no <color rgba=",
    ),
    "hinge": (
        BOX.replace("</robot>", LINK2.format("revolute", "base")),
        "9: joint 'j' is 'revolute'; .* must be 'fixed'",
    ),
    "lost joint": (BOX.replace("</robot>", LINK2.format("fixed", "c")), "9: no link is named 'c'; links are base, b"),
    "loose link": (BOX.replace("</robot>", '<link name="b"/></robot>'), "2: links must hang together"),
    "circle": (BOX.replace("</robot>", LINK2.format("fixed", "b")), "2: joints run in a circle among b"),
    "friction": (
        BOX.replace("<inertial>", '<contact><lateral_friction value="9"/></contact><inertial>'),
        "4: <lateral_friction> value must lie in 0.01 to 4.99",
    ),
    "two inertials": (BOX.replace("<inertial>", "<inertial/><inertial>"), "4: <link> holds a second <inertial>"),
}


@pytest.mark.parametrize("case", BAD_URDF)
def test_a_bad_model_is_refused_with_its_line(tmp_path, case):
    urdf, expected = BAD_URDF[case]
    with pytest.raises(InputError, match=_literal(f"red_box/model.urdf:{expected}")) as caught:
        load_object(folder(tmp_path, urdf))
    assert "\n" not in str(caught.value)


BAD_TOML = {
    "not toml": ('name = "box"\ncolors = [red]\n', "2: not TOML"),
    "open end": ('name = "box', "1: not TOML"),
    "unknown key": ('name = "box"\ncolour = ["red"]\n', "2: unknown key 'colour'; .* Did you mean 'colors'"),
    "table": ("[object]\nname = 1\n", "1: unknown key 'object'"),
    "name of no text": ("category = 'x'\nname = 3\n", "2: name must be a text, got 3"),
    "blank name": ("name = ' '\n", "1: name must be a text"),
    "colours of no list": ('colors = "red"\n', "1: colors must be a list of texts"),
    "unknown colour": (
        'name = "box"\n\ncolors = ["reddish"]\n',
        "3: unknown colour 'reddish'; allowed are red, orange",
    ),
    "uses of no text": ("uses = [1]\n", "1: uses must be a list of texts"),
}


@pytest.mark.parametrize("case", BAD_TOML)
def test_a_bad_description_is_refused_with_its_line(tmp_path, case):
    toml, expected = BAD_TOML[case]
    with pytest.raises(InputError, match=_literal(f"red_box/object.toml:{expected}")):
        load_object(folder(tmp_path, toml=toml))


def _literal(text: str) -> str:
    return text.replace("(", r"\(").replace(")", r"\)")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "holds no triangles|not a mesh"),
        ("v 0 0 x\nf 1 1 1\n", "not a mesh"),
        ("f 1 2 9\n", "holds no triangles|not a mesh"),
    ],
)
def test_an_unreadable_mesh_names_itself_and_the_line(tmp_path, content, reason):
    place = with_mesh(tmp_path, angle_iron())
    (place / "shape.obj").write_text(content)
    with pytest.raises(InputError, match=rf"model\.urdf:5: mesh cannot be used: .*shape\.obj: ({reason})"):
        load_object(place)


def test_a_flat_collision_mesh_is_refused(tmp_path):
    place = with_mesh(tmp_path, angle_iron())
    (place / "shape.obj").write_text("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"model\.urdf:7: shape\.obj: a collision mesh is flat"):
        load_object(place)


def test_folders_without_objects_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        load_objects(tmp_path / "nowhere")
    with pytest.raises(InputError, match="holds no object folders"):
        load_objects(tmp_path)
    with pytest.raises(InputError, match="name the folder above it"):
        load_objects(folder(tmp_path))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty/model\.urdf: no such file"):
        load_objects(tmp_path)


def test_two_objects_of_one_name_are_refused(tmp_path):
    folder(tmp_path, toml='name = "box"', name="a")
    folder(tmp_path, toml='name = "box"', name="b")
    with pytest.raises(InputError, match=r"/b: named 'box', as is .*/a; names must differ"):
        load_objects(tmp_path)


def test_without_trimesh_the_message_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(meshes, "_installed", lambda package: False)
    from thinkgrasp.errors import MissingDependency

    with pytest.raises(MissingDependency, match="needs the package 'trimesh'"):
        load_object(with_mesh(tmp_path, angle_iron()))


@pytest.mark.skipif(not YCB.is_dir(), reason=f"no scanned objects at {YCB}")
def test_scanned_objects():
    objects = {o.name: o for o in load_objects(YCB)}
    assert list(objects) == ["banana", "cracker box", "mustard bottle", "scissors", "tomato soup can"]
    pieces = {name: len(o.collisions) for name, o in objects.items()}
    assert pieces == {"banana": 6, "cracker box": 1, "mustard bottle": 4, "scissors": 14, "tomato soup can": 1}
    can = objects["tomato soup can"]
    assert (can.category, can.colors, can.uses, can.mass_kg) == ("can", ("red",), ("eat",), 0.349)
    assert np.allclose(np.diff(can.bounds_m, axis=0)[0], [0.068, 0.068, 0.102], atol=1e-3)
    for obj in objects.values():
        assert np.allclose(obj.bounds_m.mean(axis=0), 0, atol=1e-6)
        touched = np.concatenate(points_of(obj))
        assert np.allclose(touched.min(axis=0), obj.bounds_m[0], atol=0.008)
        assert np.allclose(touched.max(axis=0), obj.bounds_m[1], atol=0.008)
