"""Table tops with simple solids, rendered to RGB-D by exact ray casting: pure numpy, deterministic.

World frame: z up, the table's upper surface at z = 0. It serves the demonstration and the tests; nothing moves here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import invert, make_transform
from thinkgrasp.sim.solids import RGB, Bowl, Box, Cup, Cylinder, Ellipsoid, Float, Paint, Solid, Tube
from thinkgrasp.types import CameraIntrinsics, Frame

LIGHTS = np.array([[-0.52, -0.60, 1.0], [-0.46, -0.68, 1.0], [-0.43, -0.57, 1.0]])
"""Directions to the light; several near one another soften the shadows."""
AMBIENT = 0.48
FAR_M = 6.0
"""No depth beyond this."""
BACKGROUND = (168, 172, 178)


@dataclass(frozen=True, eq=False)
class TableObject:
    """One nameable thing: solids that move together."""

    name: str
    solids: tuple[Solid, ...]
    T_world_object: Float
    """(4, 4) object to world."""


@dataclass(frozen=True, eq=False)
class TabletopScene:
    """Things on a table over a floor."""

    objects: tuple[TableObject, ...]
    table_size_m: tuple[float, float] = (1.2, 0.8)
    """Along world x and y, centred at the origin."""
    table_color: RGB = (186, 160, 128)
    floor_height_m: float = -0.75
    floor_color: RGB = (120, 118, 116)
    background: tuple[TableObject, ...] = ()
    """Furniture that is no object: rendered with label -1."""

    @property
    def table(self) -> TableObject:
        """The table top, 4 cm thick."""
        slab = Box((*self.table_size_m, 0.04), Paint(self.table_color))
        return TableObject("table", (slab,), make_transform(np.eye(3), np.array([0.0, 0.0, -0.02])))


@dataclass(frozen=True, eq=False)
class Rendering:
    """A rendered frame and what is known about it."""

    frame: Frame
    labels: NDArray[np.int32]
    """(H, W) index of the object seen at each pixel; -1 = none. From exact depth, before noise and dropouts."""
    visible_fraction: tuple[float, ...]
    """Per object: pixels seen over pixels it would cover in this image alone; 0 when it is outside the image."""

    def mask(self, index: int) -> NDArray[np.bool_]:
        """Return the pixels (H, W) of one object."""
        return self.labels == index


def look_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> Float:
    """Return T_world_camera (4, 4) of a level camera at `eye` that looks at `target` [m].

    Raises:
        InputError: The two coincide.
    """
    forward = np.asarray(target, np.float64) - np.asarray(eye, np.float64)
    distance = np.linalg.norm(forward)
    if distance < 1e-9:
        raise InputError(f"eye and target coincide at {eye}")
    z = forward / distance
    up = np.array([0.0, 0, 1]) if abs(z[2]) < 0.999999 else np.array([0.0, 1, 0])
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    return make_transform(np.stack([x, np.cross(z, x), z], axis=1), np.asarray(eye, np.float64))


def render(
    scene: TabletopScene,
    camera: CameraIntrinsics,
    T_world_camera: Float,
    *,
    rng: np.random.Generator | None = None,
    noise: bool = True,
    dropout: float = 0.0,
) -> Rendering:
    """Render a scene to colour, depth and labels.

    Args:
        scene: What is there.
        camera: Pinhole intrinsics.
        T_world_camera: (4, 4) camera to world.
        rng: Source of the noise; seed 0 when None. Not used without noise and dropout.
        noise: Sensor model: depth noise that grows with the square of the distance, holes at depth edges and on
            surfaces seen at a grazing angle, depth rounded to millimetres, colour noise and slight blur. Without it
            depth is exact.
        dropout: Share of all pixels, 0..1, that additionally lose their depth in patches.

    Returns:
        The frame (its T_world_camera is set), labels and visible fractions.

    Raises:
        InputError: dropout is outside 0..1.
    """
    if not 0 <= dropout <= 1:
        raise InputError(f"dropout must be in 0..1, got {dropout}")
    rng = rng or np.random.default_rng(0)
    buffers = _cast_primary(scene, camera, T_world_camera)
    color = _shade(scene, buffers, T_world_camera)
    depth = np.where(buffers.depth <= FAR_M, buffers.depth, 0.0)
    if noise:
        depth = _depth_noise(depth, buffers, T_world_camera, rng)
        blurred = ndimage.convolve1d(ndimage.convolve1d(color, [0.25, 0.5, 0.25], axis=0), [0.25, 0.5, 0.25], axis=1)
        color = blurred + rng.normal(0.0, 0.01, color.shape)
    if dropout > 0:
        depth = np.where(_patches(depth.shape, dropout, rng), 0.0, depth)
    seen = np.bincount(buffers.labels[buffers.labels >= 0], minlength=len(scene.objects))
    fractions = tuple(float(s / a) if a else 0.0 for s, a in zip(seen, buffers.alone, strict=True))
    pixels = np.round(np.clip(color, 0, 1) * 255).astype(np.uint8)
    frame = Frame(pixels, depth.astype(np.float32), camera, T_world_camera)
    return Rendering(frame, buffers.labels, fractions)


@dataclass(frozen=True, eq=False)
class _Buffers:
    directions: Float
    """(H, W, 3) rays in the world frame, scaled so that the ray parameter is the depth."""
    depth: Float
    labels: NDArray[np.int32]
    normals: Float
    albedo: Float
    alone: NDArray[np.int64]
    """Pixels that each object covers without the others."""


def _parts(scene: TabletopScene) -> list[tuple[int, Solid, Float]]:
    """Every solid with its label and T_world_solid; furniture has label -1."""
    things = [*enumerate(scene.objects), (-1, scene.table), *((-1, thing) for thing in scene.background)]
    return [(i, solid, thing.T_world_object @ solid.T_object_solid) for i, thing in things for solid in thing.solids]


def _corners(solid: Solid) -> Float:
    low, high = solid.aabb
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def _window(solid: Solid, T_camera_solid: Float, camera: CameraIntrinsics) -> tuple[slice, slice]:
    """The rows and columns that can see the solid."""
    corners = _corners(solid) @ T_camera_solid[:3, :3].T + T_camera_solid[:3, 3]
    if (corners[:, 2] < 0.01).any():
        return slice(0, camera.height), slice(0, camera.width)
    uv = camera.project(corners)
    low = np.clip(np.floor(uv.min(axis=0)), 0, [camera.width, camera.height]).astype(int)
    high = np.clip(np.ceil(uv.max(axis=0)) + 1, 0, [camera.width, camera.height]).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def _cast_primary(scene: TabletopScene, camera: CameraIntrinsics, T_world_camera: Float) -> _Buffers:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    directions = rays @ T_world_camera[:3, :3].T
    eye = T_world_camera[:3, 3]

    with np.errstate(divide="ignore"):
        depth = (scene.floor_height_m - eye[2]) / directions[..., 2]
    depth[~(depth > 0)] = np.inf
    labels = np.full(u.shape, -1, np.int32)
    normals = np.broadcast_to(np.array([0.0, 0, 1]), rays.shape).copy()
    floor_or_none = np.where(np.isfinite(depth)[..., None], scene.floor_color, BACKGROUND)
    albedo = floor_or_none / 255.0
    covered: dict[int, NDArray[np.bool_]] = {}

    for label, solid, T_world_solid in _parts(scene):
        T_solid_world = invert(T_world_solid)
        window = _window(solid, invert(T_world_camera) @ T_world_solid, camera)
        d = directions[window].reshape(-1, 3) @ T_solid_world[:3, :3].T
        if len(d) == 0:
            continue
        o = T_solid_world[:3, :3] @ eye + T_solid_world[:3, 3]
        per_surface = solid.distances(o, d)
        surface = np.argmin(per_surface, axis=0)
        t = np.take_along_axis(per_surface, surface[None], axis=0)[0]
        size = depth[window].shape
        if label >= 0:
            covered.setdefault(label, np.zeros(u.shape, bool))[window] |= np.isfinite(t).reshape(size)
        nearer = t < depth[window].ravel()
        points = o + t[nearer, None] * d[nearer]
        where = nearer.reshape(size)
        depth[window][where] = t[nearer]
        labels[window][where] = label
        normals[window][where] = solid.normals(points, surface[nearer]) @ T_world_solid[:3, :3].T
        albedo[window][where] = solid.paint.at(points)
    alone = np.array([covered[i].sum() if i in covered else 0 for i in range(len(scene.objects))], np.int64)
    return _Buffers(directions, depth, labels, normals, albedo, alone)


def _shade(scene: TabletopScene, buffers: _Buffers, T_world_camera: Float) -> Float:
    """Lambert with ambient light and shadows, (H, W, 3) in 0..1."""
    hit = np.isfinite(buffers.depth) & (buffers.depth <= FAR_M)
    normals = buffers.normals[hit]
    points = T_world_camera[:3, 3] + buffers.depth[hit][:, None] * buffers.directions[hit] + 8e-4 * normals
    lights = LIGHTS / np.linalg.norm(LIGHTS, axis=1, keepdims=True)
    diffuse = np.zeros(len(points))
    for light in lights:
        facing = np.maximum(normals @ light, 0.0)
        diffuse += facing * ~_shadowed(scene, points, light, facing > 0)
    sky = 0.5 + 0.5 * normals[:, 2]
    light_level = AMBIENT * (0.6 + 0.4 * sky) + 0.66 * diffuse / len(lights)
    color = buffers.albedo.copy()
    color[hit] *= light_level[:, None]
    return color


def _shadowed(scene: TabletopScene, points: Float, light: Float, ask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether something lies between each point (N, 3) and the light; False where `ask` is False."""
    dark = np.zeros(len(points), bool)
    x = np.cross(light, [0.0, 1.0, 0.0])
    across = np.stack([x, np.cross(light, x)], axis=1)
    flat = points @ across
    for _, solid, T_world_solid in _parts(scene):
        corners = _corners(solid) @ T_world_solid[:3, :3].T + T_world_solid[:3, 3]
        shadow = corners @ across
        low, high = shadow.min(axis=0), shadow.max(axis=0)
        near = ask & ~dark & (points[:, 2] < corners[:, 2].max())  # every light is above
        near &= (flat[:, 0] >= low[0]) & (flat[:, 0] <= high[0]) & (flat[:, 1] >= low[1]) & (flat[:, 1] <= high[1])
        index = np.flatnonzero(near)
        if len(index) == 0:
            continue
        T_solid_world = invert(T_world_solid)
        o = points[index] @ T_solid_world[:3, :3].T + T_solid_world[:3, 3]
        d = np.broadcast_to(T_solid_world[:3, :3] @ light, o.shape)
        dark[index] = np.isfinite(solid.distances(o, d)).any(axis=0)
    return dark


def _depth_noise(depth: Float, buffers: _Buffers, T_world_camera: Float, rng: np.random.Generator) -> Float:
    """Noise with standard deviation 1.2 mm at 1 m, holes at edges and grazing angles, rounded to millimetres."""
    sigma = 0.0012 * depth * depth
    grain = ndimage.gaussian_filter(rng.standard_normal(depth.shape), 1.0)
    noisy = depth + sigma * grain / grain.std()
    spread = ndimage.maximum_filter(depth, 3) - ndimage.minimum_filter(depth, 3)
    edge = (spread > np.maximum(0.02, 0.05 * depth)) & (rng.random(depth.shape) < 0.5)
    rays = buffers.directions / np.linalg.norm(buffers.directions, axis=-1, keepdims=True)
    grazing = np.abs(np.einsum("hwi,hwi->hw", rays, buffers.normals)) < 0.12
    return np.where((depth > 0) & ~edge & ~grazing, np.round(noisy, 3), 0.0)


def _patches(shape: tuple[int, ...], share: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """A blotchy mask that covers this share of the image."""
    field = ndimage.gaussian_filter(rng.standard_normal(shape), 6.0)
    return field <= np.quantile(field, share)


def pose(x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> Float:
    """Return T_world_object (4, 4) at (x, y, z) [m], turned by yaw [rad] about the vertical."""
    c, s = np.cos(yaw), np.sin(yaw)
    return make_transform(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array([x, y, z]))


def _lying(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Float:
    """A solid's pose with its z axis along the object's x axis."""
    return make_transform(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.array([x, y, z]))


# Objects below have their lowest point at z = 0 of their frame.


def box(name: str, size_m: tuple[float, float, float], paint: Paint, T_world_object: Float) -> TableObject:
    """Return a cuboid."""
    return TableObject(name, (Box(size_m, paint, pose(0, 0, size_m[2] / 2)),), T_world_object)


def can(name: str, radius_m: float, height_m: float, paint: Paint, T_world_object: Float) -> TableObject:
    """Return an upright closed cylinder."""
    return TableObject(name, (Cylinder(radius_m, height_m, paint, pose(0, 0, height_m / 2)),), T_world_object)


def ball(name: str, radius_m: float, paint: Paint, T_world_object: Float) -> TableObject:
    """Return a sphere."""
    return TableObject(name, (Ellipsoid((radius_m, radius_m, radius_m), paint, pose(0, 0, radius_m)),), T_world_object)


def cup(name: str, radius_m: float, height_m: float, paint: Paint, T_world_object: Float) -> TableObject:
    """Return an open cup that widens by a fifth towards its rim."""
    return TableObject(name, (Cup(radius_m, height_m, paint, top_radius_m=1.2 * radius_m),), T_world_object)


def mug(name: str, radius_m: float, height_m: float, paint: Paint, T_world_object: Float) -> TableObject:
    """Return an open cylinder with a round handle on its +x side."""
    angle = np.linspace(-0.45 * np.pi, 0.45 * np.pi, 9)
    reach, rise = 0.032, 0.33 * height_m
    path = np.stack(
        [radius_m + reach * np.cos(angle) - 0.004, np.zeros(9), height_m / 2 + rise * np.sin(angle)], axis=1
    )
    handle = Tube(path, (0.006,) * 9, paint)
    return TableObject(name, (Cup(radius_m, height_m, paint), handle), T_world_object)


def bowl(name: str, radius_m: float, height_m: float, paint: Paint, T_world_object: Float) -> TableObject:
    """Return a spherical bowl on a low foot; `radius_m` is the sphere's."""
    foot = Cylinder(0.45 * radius_m, 0.008, paint, pose(0, 0, 0.004))
    return TableObject(name, (Bowl(radius_m, height_m, paint, pose(0, 0, 0.002)), foot), T_world_object)


def banana(name: str, T_world_object: Float, paint: Paint | None = None) -> TableObject:
    """Return a curved fruit of 18 cm that lies flat."""
    angle = np.linspace(-0.8, 0.8, 13)
    bend, radius = 0.115, 0.017
    path = np.stack([bend * np.sin(angle), bend * (np.cos(angle) - 0.85), np.full(13, radius)], axis=1)
    thickness = radius * (0.45 + 0.55 * np.cos(angle / 0.8 * 1.25))
    fruit = Tube(path, tuple(thickness), paint or Paint((232, 201, 48), (96, 78, 30), (-1.0, -0.080), axis=0))
    return TableObject(name, (fruit,), T_world_object)


def marker(name: str, paint: Paint, T_world_object: Float) -> TableObject:
    """Return a pen of 12 cm and 18 mm that lies along its x axis, with a darker cap."""
    barrel = Cylinder(0.009, 0.085, paint, _lying(-0.0175, 0, 0.009))
    cap = Cylinder(0.0095, 0.035, Paint((40, 40, 44)), _lying(0.0425, 0, 0.0095))
    return TableObject(name, (barrel, cap), T_world_object)


def drill(name: str, T_world_object: Float, paint: Paint | None = None) -> TableObject:
    """Return a cordless drill that lies on its side, 18 cm long."""
    shell, dark = paint or Paint((224, 112, 26)), Paint((45, 46, 50))
    body = Cylinder(0.026, 0.10, shell, _lying(0, 0.045, 0.026))
    chuck = Cylinder(0.018, 0.05, dark, _lying(0.075, 0.045, 0.026), top_radius_m=0.010)
    grip = Box((0.034, 0.10, 0.030), shell, pose(-0.030, -0.02, 0.026, -0.15))
    battery = Box((0.072, 0.034, 0.052), dark, pose(-0.030, -0.078, 0.026))
    return TableObject(name, (body, chuck, grip, battery), T_world_object)


def demo_scene(seed: int = 0) -> TabletopScene:
    """Return ten household things on a table, each moved and turned a little by the seed.

    Some touch, one stands on another and one in another; behind is a second table, below is the floor.
    """
    rng = np.random.default_rng(seed)

    def at(x: float, y: float, yaw: float = 0.0, z: float = 0.0, turn: float = 0.25) -> Float:
        dx, dy = rng.uniform(-0.008, 0.008, 2)
        return pose(x + dx, y + dy, z, yaw + rng.uniform(-turn, turn))

    red_box = at(-0.13, 0.16, 0.1)
    pudding = at(0.21, -0.03, 0.5)
    dish = at(0.30, 0.17)
    beside = pose(0.1145, 0.0)
    objects = (
        box("red cracker box", (0.16, 0.06, 0.21), Paint((190, 36, 34), (240, 214, 150), (0.02, 0.06)), red_box),
        can("tomato soup can", 0.034, 0.10, Paint((238, 236, 230), (196, 40, 36), (-0.002, 0.04)), red_box @ beside),
        mug("white mug", 0.041, 0.085, Paint((232, 232, 228)), at(0.03, -0.10, -0.6)),
        banana("banana", at(-0.20, -0.11, 0.5)),
        bowl("green bowl", 0.082, 0.055, Paint((64, 150, 84)), dish),
        ball("purple ball", 0.024, Paint((122, 62, 160)), dish @ pose(0.01, 0.0, 0.008)),
        box("pudding box", (0.11, 0.085, 0.035), Paint((120, 74, 42), (222, 196, 160), (-0.02, 0.02), 0), pudding),
        cup("blue cup", 0.027, 0.075, Paint((44, 92, 190)), pudding @ pose(0.01, 0.0, 0.035)),
        marker("marker", Paint((30, 60, 140)), at(-0.03, -0.215, 0.25)),
        drill("drill", at(0.10, 0.19, 0.6)),
    )
    desk = Box((1.6, 0.6, 0.04), Paint((96, 74, 60)), pose(0.3, 1.6, -0.10))
    leg = Box((0.06, 0.06, 0.63), Paint((60, 60, 64)), pose(0.0, 1.35, -0.435))
    return TabletopScene(objects, background=(TableObject("desk", (desk, leg), np.eye(4)),))


def demo_camera() -> tuple[CameraIntrinsics, Float]:
    """Return a 640x480 camera and its pose T_world_camera that see the demonstration scene from the front."""
    return CameraIntrinsics(640, 480, 590.0, 590.0, 319.5, 239.5), look_at((0.0, -0.62, 0.62), (0.03, 0.02, 0.02))
