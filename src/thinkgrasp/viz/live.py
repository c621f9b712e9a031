"""The running episode in the browser: what is seen, what was decided, what the robot does."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from html import escape
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, ContractError, MissingDependency
from thinkgrasp.geometry import apply
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Decision, Grasp, Outcome
from thinkgrasp.viz.glyphs import GRIPPER, STATUS, STATUS_TEXT, TARGET, Float, box_corners, plain_text, to_camera
from thinkgrasp.viz.view import score_color

MAX_POINTS = 40_000
MAX_CANDIDATES = 12
POINT_SIZE_M = 0.003
STEM_M = 0.03
EDGES = np.array([[a, b] for a in range(8) for b in range(8) if a < b and (a ^ b) in (1, 2, 4)])
"""Corner indices of a box's twelve edges."""

Triple = tuple[int, int, int]


class LiveView:
    """Serve a page that follows an episode; an observer with `record`, like a recorder.

    Everything is shown in the world frame, or in the camera's where the camera pose is unknown.

    Args:
        gripper: Geometry of the gripper to draw.
        port: Port to serve on; where it is taken the next free one is used.
        host: Address to listen on; the default is reachable from this machine only.

    Raises:
        MissingDependency: viser is not installed.
        ConfigError: No port can be opened.
    """

    def __init__(self, gripper: Gripper, *, port: int = 8080, host: str = "127.0.0.1") -> None:
        try:
            import viser
        except ImportError as error:
            raise MissingDependency("viser", "viz", "the live view") from error
        try:
            with _stdout_is_ours():
                self._server = viser.ViserServer(host=host, port=port, label="ThinkGrasp", verbose=False)
        except OSError as error:
            raise ConfigError(f"the live view cannot listen on {host}:{port}: {error}") from error
        self._gripper = gripper
        self._host = host
        self._step = 0
        self._of_step: list[Any] = []
        """Handles of what belongs to the decision shown."""
        self._moving: dict[str, Any] = {}
        server = self._server
        server.gui.configure_theme(dark_mode=True, control_width="large", show_logo=False, show_share_button=False)
        server.scene.set_background_image(np.full((1, 1, 3), (20, 23, 27), np.uint8))
        self._stand(world=True)
        self._words = server.gui.add_html(_page("<p>Waiting for the first decision.</p>"))
        self._shown: Decision | None = None
        self._pending = False
        with server.gui.add_folder("Show"):
            self._switches = {
                name: server.gui.add_checkbox(label, initial_value=True)
                for name, label in (
                    ("cloud", "Perceived cloud"),
                    ("candidates", "Other candidates"),
                    ("labels", "Marks"),
                    ("world", "Robot and objects"),
                )
            }
        for name, switch in self._switches.items():
            switch.on_update(lambda _, name=name: self._toggle(name))

    def __enter__(self) -> LiveView:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def url(self) -> str:
        """Where to look."""
        return (
            f"http://{'localhost' if self._host in ('127.0.0.1', '0.0.0.0') else self._host}:{self._server.get_port()}"
        )

    def close(self) -> None:
        """Stop serving."""
        with _stdout_is_ours():
            self._server.stop()

    def record(self, decision: Decision, outcome: Outcome | None) -> None:
        """Show one finished step."""
        if not self._pending or self._shown is not decision:
            self.update_decision(decision)
        self.update_outcome(outcome)
        self._pending = False

    def update_decision(self, decision: Decision) -> None:
        """Show what was decided: the cloud, the marks, the candidates and the chosen grasp."""
        self._step += 1
        if self._step == 1 and decision.scene.frame.T_world_camera is None:
            self._stand(world=False)
        self._shown, self._pending = decision, True
        with self._server.atomic():
            for handle in self._of_step:
                handle.remove()
            self._of_step = [*self._cloud(decision), *self._labels(decision), *self._grasps(decision)]
            self._words.content = _page(_said(self._step, decision, "Executing" if decision.grasp else ""))

    def update_outcome(self, outcome: Outcome | None) -> None:
        """Show what became of the decision shown.

        Raises:
            ContractError: No decision has been shown.
        """
        if self._shown is None:
            raise ContractError("update_outcome needs a decision before it: call update_decision first")
        result = "Not executed" if outcome is None else outcome.reason.replace("_", " ").capitalize()
        good = None if outcome is None else outcome.success
        self._words.content = _page(_said(self._step, self._shown, result, good))

    def set_meshes(
        self,
        names: Sequence[str],
        vertices: Sequence[NDArray[np.floating]],
        faces: Sequence[NDArray[np.integer]],
        colors: Sequence[Triple],
    ) -> None:
        """Replace the robot and the objects; they stand at the origin until `set_poses`.

        Args:
            names: One unique name per mesh.
            vertices: (V, 3) each [m], in the mesh's own frame.
            faces: (F, 3) each, vertex indices.
            colors: RGB 0..255 each.

        Raises:
            ContractError: The lists differ in length, or a name comes twice.
        """
        lengths = {len(names), len(vertices), len(faces), len(colors)}
        if len(lengths) != 1 or len(set(names)) != len(names):
            raise ContractError(
                f"set_meshes needs one unique name, vertices, faces and colour per mesh, got {len(names)} names "
                f"({len(set(names))} different), {len(vertices)} vertices, {len(faces)} faces, {len(colors)} colours"
            )
        with self._server.atomic():
            for handle in self._moving.values():
                handle.remove()
            self._moving = {
                name: self._server.scene.add_mesh_simple(
                    f"/world/{i}",
                    np.asarray(v, np.float32),
                    np.asarray(f, np.uint32),
                    color=color,
                    flat_shading=True,
                    visible=self._switches["world"].value,
                )
                for i, (name, v, f, color) in enumerate(zip(names, vertices, faces, colors, strict=True))
            }

    def set_poses(
        self, names: Sequence[str], quats_wxyz: NDArray[np.floating], positions: NDArray[np.floating]
    ) -> None:
        """Move meshes.

        Args:
            names: Names given to `set_meshes`.
            quats_wxyz: (N, 4) unit quaternions, mesh to world.
            positions: (N, 3) [m] in the world frame.

        Raises:
            ContractError: A name is unknown, or the lengths differ.
        """
        unknown = [name for name in names if name not in self._moving]
        if unknown or not len(names) == len(quats_wxyz) == len(positions):
            raise ContractError(
                f"set_poses needs known names with one quaternion and position each; unknown: {unknown[:5]}, got "
                f"{len(names)} names, {len(quats_wxyz)} quaternions, {len(positions)} positions"
            )
        with self._server.atomic():
            for name, quat_wxyz, position in zip(names, quats_wxyz, positions, strict=True):
                handle = self._moving[name]
                handle.wxyz, handle.position = quat_wxyz, position

    def _stand(self, *, world: bool) -> None:
        """Put the first look where the workspace fills it: from the front left, or from the camera's own place."""
        self._server.scene.set_up_direction("+z" if world else "-y")
        self._server.initial_camera.position = (1.0, -0.48, 0.5) if world else (0.0, -0.05, 0.0)
        self._server.initial_camera.look_at = (0.48, 0.08, 0.0) if world else (0.0, 0.0, 0.7)

    def _toggle(self, name: str) -> None:
        visible = self._switches[name].value
        handles = self._moving.values() if name == "world" else self._of_step
        for handle in handles:
            if name == "world" or handle.name.startswith(f"/step/{name}"):
                handle.visible = visible

    def _cloud(self, decision: Decision) -> list[Any]:
        scene = decision.scene
        index = np.flatnonzero(np.isfinite(scene.points[..., 2]))
        index = index[:: max(1, -(-len(index) // MAX_POINTS))]
        colors = scene.frame.color.reshape(-1, 3)[index]
        if decision.target is not None:
            chosen = decision.target.mask.ravel()[index]
            colors = colors.copy()
            colors[chosen] = (colors[chosen] // 2 + np.array(TARGET) // 2).astype(np.uint8)
        points = _world(decision, scene.points.reshape(-1, 3)[index].astype(np.float64))
        return [
            self._server.scene.add_point_cloud(
                "/step/cloud",
                points.astype(np.float32),
                colors,
                point_size=POINT_SIZE_M,
                visible=self._switches["cloud"].value,
            )
        ]

    def _labels(self, decision: Decision) -> list[Any]:
        return [
            self._server.scene.add_label(
                f"/step/labels/{p.mark}",
                f"{p.mark} {plain_text(decision.plan.target)}" if p.mark == decision.plan.mark else str(p.mark),
                position=_world(decision, p.center_m),
                visible=self._switches["labels"].value,
            )
            for p in decision.scene.proposals
        ]

    def _grasps(self, decision: Decision) -> list[Any]:
        handles: list[Any] = []
        others = decision.alternatives[:MAX_CANDIDATES]
        if others:
            lines = np.concatenate([_world(decision, _glyph(grasp, self._gripper)) for grasp in others])
            colors = np.repeat([score_color(g.score) for g in others], len(lines) // len(others), axis=0)
            handles.append(
                self._lines("/step/candidates", lines, colors, 0.0015, visible=self._switches["candidates"].value)
            )
        if decision.grasp is not None:
            boxes = self._gripper.bodies(decision.grasp.width_m)
            edges = [to_camera(decision.grasp, box_corners(box))[EDGES] for box in boxes]
            lines = _world(decision, np.concatenate(edges))
            handles.append(self._lines("/step/chosen", lines, np.tile(GRIPPER, (len(lines), 1)), 0.003, visible=True))
        return handles

    def _lines(self, name: str, lines: Float, colors: NDArray[np.integer], thickness_m: float, *, visible: bool) -> Any:
        """Add segments (N, 2, 3), each in its colour (N, 3)."""
        ends = np.repeat(colors[:, None].astype(np.uint8), 2, axis=1)
        return self._server.scene.add_line_segments(
            name, lines.astype(np.float32), ends, thickness=thickness_m, thickness_units="world", visible=visible
        )


def _stdout_is_ours() -> contextlib.AbstractContextManager[object]:
    """viser announces itself on stdout, where only results belong."""
    return contextlib.redirect_stdout(sys.stderr)


def _world(decision: Decision, points: Float) -> Float:
    """Points (..., 3) in the world frame where the camera pose is known."""
    T = decision.scene.frame.T_world_camera
    return points if T is None else np.asarray(apply(T, points), np.float64)


def _glyph(grasp: Grasp, gripper: Gripper) -> Float:
    """Four segments (4, 2, 3) in the camera frame: two fingers, a bridge and a stem."""
    h, L = grasp.width_m / 2, gripper.finger_length_m
    local = np.array(
        [
            [[-h, 0, -L], [-h, 0, 0]],
            [[h, 0, -L], [h, 0, 0]],
            [[-h, 0, -L], [h, 0, -L]],
            [[0, 0, -L - STEM_M], [0, 0, -L]],
        ]
    )
    return to_camera(grasp, local)


def _said(step: int, decision: Decision, result: str, good: bool | None = None) -> str:
    plan = decision.plan
    role = "goal" if plan.role == "goal" else "in the way of the goal"
    sign = "" if good is None else "✓ " if good else "✕ "
    facts = [
        ("Step", str(step)),
        ("Target", f"{plan.target} ({role})"),
        ("Cell", f"{plan.cell} of {plan.grid} × {plan.grid}"),
        ("Decided in", f"{dict(decision.timings_ms).get('total', 0.0):.0f} ms"),
        ("Outcome", sign + result),
    ]
    if decision.funnel:
        facts.insert(3, ("Grasps left", f"{decision.funnel[-1].n_out} of {decision.funnel[0].n_in}"))
    rows = "".join(f"<tr><th>{name}</th><td>{_text(value)}</td></tr>" for name, value in facts)
    color = "#{:02x}{:02x}{:02x}".format(*STATUS[decision.status])
    fell = "".join(f"<li>{_text(f'{d.stage}: {d.reason}; instead: {d.fallback}')}</li>" for d in decision.degraded)
    return (
        f'<h3 dir="auto">{_text(decision.instruction)}</h3>'
        f'<p><b style="color:{color}">{STATUS_TEXT[decision.status]}</b></p>'
        f'<table>{rows}</table><p dir="auto">{_text(plan.rationale)}</p>' + (f"<ul>{fell}</ul>" if fell else "")
    )


def _text(words: str) -> str:
    return escape(plain_text(words))


def _page(body: str) -> str:
    style = (
        "<style>.thinkgrasp{padding:4px 12px;font-size:13px;line-height:1.45;overflow-wrap:anywhere}"
        ".thinkgrasp h3{margin:2px 0;font-size:16px}.thinkgrasp p{margin:6px 0}"
        ".thinkgrasp table{width:100%;border-collapse:collapse}"
        ".thinkgrasp th{font-weight:400;opacity:.7;text-align:left;padding-right:12px;white-space:nowrap}"
        ".thinkgrasp td{text-align:right}.thinkgrasp ul{margin:4px 0;padding-left:16px;opacity:.8}</style>"
    )
    return f'{style}<div class="thinkgrasp">{body}</div>'
