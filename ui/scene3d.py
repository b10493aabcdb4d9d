"""The twin in 3D: its meshes moved by body poses, the predicted chunk path, the attempt's trail with flagged parts red.

Positions are metres in the arm's base frame.
"""

from __future__ import annotations

import numpy as np
import viser
from jaxtyping import Float

from far_app.session_states import State
from far_app.telemetry import BodyMesh, SceneGeometry, Telemetry
from ui.plot_model import flagged_ticks

BRAND = (63, 184, 255)
FLAGGED = (255, 77, 79)
DEEP_RED, DEEP_BLUE, TRAIL = (200, 0, 8), (0, 90, 220), (40, 58, 80)
"""For lines in 3D, which the lights wash out."""
STILL = 1e-5
"""Changes of a body's pose below this (metres, quaternion units) are not sent."""
TRAIL_LIMIT = 600
"""Points of the trail at most; older ones go."""


class Scene3D:
    """Owns what is drawn; call from one thread."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._scene = server.scene
        self._frames: dict[int, viser.FrameHandle] = {}
        self._shown: Float[np.ndarray, "B 7"] | None = None
        self._trail: list[tuple[int, Float[np.ndarray, "3"]]] = []
        self._attempt = (0, 0)
        self._path: viser.LineSegmentsHandle | None = None
        self._trail_line: viser.LineSegmentsHandle | None = None
        self._trail_key: tuple[object, ...] = ()
        server.initial_camera.position = (1.22, -0.82, 0.68)
        server.initial_camera.look_at = (0.3, 0.03, 0.2)
        server.initial_camera.fov = 0.66
        self._scene.configure_default_lights(enabled=True, cast_shadow=False)

    def build(self, geometry: SceneGeometry) -> None:
        """Meshes under one frame a body; called once for each hw server."""
        for frame in self._frames.values():
            frame.remove()
        self._frames.clear()
        self._shown = None
        for index, mesh in enumerate(geometry.meshes):
            if mesh.body not in self._frames:
                self._frames[mesh.body] = self._scene.add_frame(f"/twin/{mesh.body}", show_axes=False)
            r, g, b = _tinted(mesh)
            a = mesh.rgba[3]
            self._scene.add_mesh_simple(
                f"/twin/{mesh.body}/{index}",
                vertices=np.asarray(mesh.vertices, dtype=np.float32),
                faces=np.asarray(mesh.faces, dtype=np.uint32),
                color=(int(255 * r), int(255 * g), int(255 * b)),
                opacity=None if a >= 1 else float(a),
                cast_shadow=False,
                receive_shadow=False,
                flat_shading=len(mesh.vertices) <= 8,
                side="double",
            )

    def pose(self, body_poses: Float[np.ndarray, "B 7"]) -> None:
        """Position and xyzw quaternion by body; only what moved is sent."""
        before = self._shown
        for body, frame in self._frames.items():
            if body >= len(body_poses):
                continue
            if before is not None and np.abs(body_poses[body] - before[body]).max() < STILL:
                continue
            x, y, z, w = body_poses[body, 3:7]
            frame.position = body_poses[body, :3]
            frame.wxyz = np.array([w, x, y, z])
        if before is None:
            self._shown = np.array(body_poses)
        else:
            moved = np.abs(body_poses - before).max(axis=1) >= STILL
            before[moved] = body_poses[moved]

    def chunk(self, telemetry: Telemetry) -> None:
        """The path of the newest chunk while it is followed, blue; red when that chunk is flagged."""
        points = np.asarray(telemetry.chunk_path, dtype=np.float32)
        if len(points) < 2 or telemetry.state not in (State.RUNNING, State.TAKEN_OVER):
            if self._path is not None:
                self._path.visible = False
            return
        segments = np.stack([points[:-1], points[1:]], axis=1)
        color = DEEP_RED if telemetry.tick in telemetry.flagged else DEEP_BLUE
        colors = np.broadcast_to(np.array(color, np.uint8), segments.shape).copy()
        if self._path is None or self._path.points.shape != segments.shape:
            self._path = self._scene.add_line_segments("/chunk", segments, colors, thickness=0.01)
        else:
            self._path.points, self._path.colors, self._path.visible = segments, colors, True

    def follow(self, telemetry: Telemetry) -> None:
        """Remember where the hand is in this attempt."""
        attempt = (telemetry.trial, telemetry.attempt)
        if attempt != self._attempt:
            self._attempt, self._trail = attempt, []
        eef, running = telemetry.eef, telemetry.state in (State.RUNNING, State.TAKEN_OVER)
        if eef is not None and running and (not self._trail or telemetry.tick > self._trail[-1][0]):
            self._trail.append((telemetry.tick, np.array(eef.position, dtype=np.float32)))
            del self._trail[:-TRAIL_LIMIT]

    def trail(self, telemetry: Telemetry) -> None:
        """Where the hand has been; after a failure the flagged chunks' parts turn red."""
        key = (self._attempt, len(self._trail), telemetry.flagged)
        if key == self._trail_key:
            return
        self._trail_key = key
        if len(self._trail) < 2:
            if self._trail_line is not None:
                self._trail_line.visible = False
            return
        points = np.stack([p for _, p in self._trail])
        segments = np.stack([points[:-1], points[1:]], axis=1)
        covered = flagged_ticks(telemetry.flagged, telemetry.chunk_horizon, self._trail[-1][0] + 1)
        red = np.array([covered[tick] for tick, _ in self._trail[1:]])
        colors = np.where(red[:, None, None], np.array(DEEP_RED, np.uint8), np.array(TRAIL, np.uint8))
        colors = np.broadcast_to(colors, segments.shape).astype(np.uint8)
        self._trail_line = self._scene.add_line_segments("/trail", segments, colors, thickness=0.008)


def _tinted(mesh: BodyMesh) -> tuple[float, float, float]:
    """A mesh's colour under the page's lights; furniture (over half a metre) dimmed so that the arm stands out."""
    r, g, b, _ = mesh.rgba
    large = float(np.ptp(mesh.vertices, axis=0).max()) > 0.5
    return (0.22 * r, 0.25 * g, 0.29 * b) if large else (0.78 * r, 0.78 * g, 0.78 * b)
