"""What the generators share that run a grasp network on a cloud: its input, and its grasps in our convention.

The networks know one frame, a camera's optical frame (x right, y down, z forward): their views and their training are
tied to it. A cloud fused from several cameras is given with the transform into one of them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, InputError, MissingDependency
from thinkgrasp.generators.other_views import owners
from thinkgrasp.geometry import apply, invert
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Array, Grasps, Mask, Scene
from thinkgrasp.weights import locate_file

if TYPE_CHECKING:
    import torch
    from torch import Tensor

MIN_POINTS = 24
"""A crop with fewer points is too little to judge."""
MAX_WIDTH_M, WIDTH_MARGIN = 0.1, 1.2
"""The nets' largest opening, and how much wider than what they measure it is."""


class Output(Protocol):
    """What a network returns."""

    @property
    def grasps(self) -> Tensor:
        """(n, 17): score, width, height, depth, rotation (9), seed (3), object id."""
        ...


class Network(Protocol):
    """A grasp network, ready to run."""

    def run(self, cloud: Array, *, wanted: NDArray[np.bool_]) -> Output:
        """Find grasps on a cloud (N, 3) that start from wanted points (N,)."""
        ...


class CloudNetworkGenerator(ABC):
    """Propose grasps with a network on the cloud about the crop.

    The network sees the workspace as far as `margin_m` around the crop, with the table and the neighbours in it,
    thinned at random to `num_point` points; grasps count whose seed lies on the crop, or on what other cameras saw of
    the things that are mostly under it.

    Args:
        weights: The official checkpoint, or any file of its state dict; or a name of weights.toml; None = the one of
            weights.toml, if it is on this machine. See docs/grasp_networks.md for its licence.
        device: "cpu", "cuda", ...; None = CUDA where there is one.
        num_point: So many points are sampled; where there are fewer, some come twice.
        margin_m: How far around the crop's bounding box the cloud reaches, in the camera frame.
        max_grasps: At most so many, best first.

    Raises:
        ConfigError: There are no weights, they are another model's, or a setting is out of range.
        MissingDependency: torch is not installed.
    """

    name: ClassVar[str]
    """Of the plug-in."""
    known: ClassVar[str]
    """The official weights in weights.toml."""

    def __init__(
        self,
        *,
        weights: str | Path | None = None,
        device: str | None = None,
        num_point: int = 20_000,
        margin_m: float = 0.2,
        max_grasps: int = 512,
    ) -> None:
        what = f"{self.name} generator"
        for key, value, least, most in (("num_point", num_point, 1024, 200_000), ("max_grasps", max_grasps, 1, 1024)):
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
                raise ConfigError(f"{what}: {key} must be a whole number within {least}..{most}, got {value!r}")
        if not 0 <= margin_m <= 10:
            raise ConfigError(f"{what}: margin_m must lie in 0..10, got {margin_m}")
        self.num_point = num_point
        self.margin_m = margin_m
        self.max_grasps = max_grasps
        try:
            from thinkgrasp.networks.checkpoint import choose_device, read_checkpoint
        except ModuleNotFoundError as error:
            if error.name != "torch":
                raise
            raise MissingDependency("torch", "graspnet", f"the {what}") from None
        chosen = choose_device(device, what=what)
        file = locate_file(weights, default=self.known, what=what)
        self._network = self.network(read_checkpoint(file, what=what), chosen)

    @staticmethod
    @abstractmethod
    def network(weights: dict[str, Tensor], device: torch.device) -> Network:
        """Return the network with these weights, on a device."""

    @staticmethod
    @abstractmethod
    def quality(scores: Array) -> Array:
        """Map the network's scores (n,) to 0..1 without changing their order."""

    def generate(self, scene: Scene, crop: Mask, gripper: Gripper, rng: np.random.Generator) -> Grasps:
        """Propose grasps on what lies under `crop` (H, W); camera frame, best first, empty where there are none.

        Raises:
            InputError: The depth is not in metres.
        """
        seen = np.isfinite(scene.points).all(axis=2)
        if scene.frame.workspace is not None:
            seen &= scene.frame.workspace
        wanted = crop & seen
        if wanted.sum() < MIN_POINTS:
            return Grasps.empty()
        low, high = np.quantile(scene.points[wanted], [0.01, 0.99], axis=0).astype(np.float32)
        with np.errstate(invalid="ignore"):
            near = (scene.points >= low - self.margin_m) & (scene.points <= high + self.margin_m)
        used = seen & near.all(axis=2)
        points, starts = scene.points[used], wanted[used]
        others = scene.frame.others
        if others is not None:
            near = ((others.points >= low - self.margin_m) & (others.points <= high + self.margin_m)).all(axis=1)
            marks = [p.mark for p in scene.proposals if np.count_nonzero(p.mask & crop) > 0.5 * p.mask.sum()]
            points = np.concatenate([points, others.points[near]])
            starts = np.concatenate([starts, np.isin(owners(scene), marks)[near]])
        return self.on_cloud(points, starts, gripper, rng)

    def on_cloud(
        self,
        points: NDArray[np.floating],
        wanted: NDArray[np.bool_],
        gripper: Gripper,
        rng: np.random.Generator,
        T_camera_cloud: NDArray[np.floating] | None = None,
    ) -> Grasps:
        """Propose grasps on a cloud that need not be an image.

        Args:
            points: (N, 3) [m]; points that are not finite are left out.
            wanted: (N,) where grasps may start; the rest is their surroundings.
            gripper: Its largest opening bounds the grasps'.
            rng: Draws the sample.
            T_camera_cloud: (4, 4) from the cloud's frame to the optical frame of a camera that saw it; None = the cloud
                is in such a frame.

        Returns:
            Grasps in the cloud's frame, best first.

        Raises:
            InputError: The points are no such cloud, or most of them lie behind the camera.
        """
        points = np.asarray(points, np.float32)
        if points.ndim != 2 or points.shape[1] != 3 or wanted.shape != points.shape[:1] or wanted.dtype != np.bool_:
            raise InputError(
                f"{self.name} generator: points must be (N, 3) and wanted (N,) bool, got {points.shape} and "
                f"{wanted.shape} {wanted.dtype}"
            )
        finite = np.isfinite(points).all(axis=1)
        points, wanted = points[finite], wanted[finite]
        if wanted.sum() < MIN_POINTS:
            return Grasps.empty()
        seen = points if T_camera_cloud is None else apply(T_camera_cloud, points).astype(np.float32)
        if np.mean(seen[:, 2] <= 0) > 0.5:
            raise InputError(
                f"{self.name} generator: most points lie behind the camera; the cloud must be in a camera's optical "
                "frame (z forward), or come with T_camera_cloud"
            )
        chosen = sample(len(seen), self.num_point, rng)
        rows = self._network.run(seen[chosen], wanted=wanted[chosen]).grasps.cpu().numpy()
        grasps = to_grasps(rows, self.quality(rows[:, 0]), gripper)
        grasps = grasps[np.argsort(-rows[:, 0], kind="stable")[: self.max_grasps]]
        return grasps if T_camera_cloud is None else _moved(grasps, invert(T_camera_cloud))


def sample(n: int, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return `count` of n indices in random order: without repeats, or all of them in order and then some twice."""
    if n >= count:
        return rng.choice(n, count, replace=False)
    return np.concatenate([np.arange(n), rng.choice(n, count - n, replace=True)])


def to_grasps(rows: Array, scores: Array, gripper: Gripper) -> Grasps:
    """Turn rows (n, 17) of a network and scores (n,) into grasps in our convention, same order.

    The TCP lies the row's depth beyond its seed, along the approach. An opening beyond the gripper's own is reduced to
    that where the margin that the networks add allows it; otherwise it is left, for the width check to see.
    """
    approach, closing, across = np.moveaxis(rows[:, 4:13].reshape(-1, 3, 3), 2, 0)
    width = rows[:, 1]
    largest = np.nextafter(np.float32(gripper.max_width_m), np.float32(0))
    fits = (width < MAX_WIDTH_M) & (width / WIDTH_MARGIN <= largest)
    return Grasps(
        np.stack([closing, across, approach], axis=2),
        (rows[:, 13:16] + rows[:, 3:4] * approach).astype(np.float32),
        np.where(fits, np.minimum(width, largest), width),
        scores,
    )


def _moved(grasps: Grasps, T_a_b: NDArray[np.float64]) -> Grasps:
    """Return grasps in b as grasps in a."""
    rotations = (T_a_b[:3, :3] @ grasps.rotations).astype(np.float32)
    positions = apply(T_a_b, grasps.positions).astype(np.float32)
    return Grasps(rotations, positions, grasps.widths, grasps.scores)
