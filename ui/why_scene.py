"""The attempt view in 3D: the hand's way, the chunk that was sent (red), its positives coloured by Q, and sampled
chunks before and after an adaptation.

Everything hangs under one frame that is shifted so that s_t lies at the origin: the view stays where the operator
turned it, and a path of a few centimetres is never out of sight.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from jaxtyping import Float

from ui.plot_model import flagged_ticks
from ui.why_model import Attribution, Case, executed, path, q_colors, trail

SENT, TRAIL, TRAIL_FLAGGED = (255, 60, 64), (72, 98, 128), (140, 44, 52)
BEFORE, AFTER = (110, 122, 136), (160, 80, 255)
OBJECT = (214, 160, 60)


class WhyScene:
    """Owns what is drawn; call from one thread."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._scene = server.scene
        server.initial_camera.position = (0.085, -0.1, 0.07)
        server.initial_camera.look_at = (0.0, 0.0, 0.01)
        server.initial_camera.fov = 0.7
        self._scene.configure_default_lights(enabled=False)
        self._scene.configure_environment_map(None)
        self._scene.add_light_ambient("/light", intensity=3.1)  # shows colours as they are
        self._world = self._scene.add_frame("/world", show_axes=False)
        self._drawn: set[str] = set()

    def show(
        self, case: Case | None, found: Attribution | None, tick: int, scale: float,
        moved: tuple[np.ndarray, np.ndarray] | None,
    ) -> None:  # fmt: skip
        """`moved`: chunks (N, H, A) sampled at s_t before and after an adaptation."""
        drawn: set[str] = set()
        here = case.observations.get(tick) if case is not None else None
        if case is not None and found is not None and here is not None:
            self._world.position = tuple(-np.asarray(here.eef.position, float))
            self._way(case, found, drawn)
            contrast = case.contrasts.get(tick)
            if contrast is not None:
                colors = q_colors(contrast.q, contrast.negative_q)
                for k in reversed(range(len(contrast.positives))):
                    self._path(
                        f"positive/{k}", path(case, tick, contrast.positives[k], scale), colors[k], 0.0016, drawn
                    )
            for name, chunks, color in zip(("before", "after"), moved or (), (BEFORE, AFTER), strict=False):
                for k, chunk in enumerate(chunks):
                    self._path(f"{name}/{k}", path(case, tick, chunk, scale), color, 0.0012, drawn)
            sent = path(case, tick, executed(case, tick, found.horizon), scale)
            self._path("sent", sent, SENT, 0.0026, drawn)
            self._ball("hand", here.eef.position, (235, 240, 245), 0.0032, drawn)
            for name, pose in here.objects.items():
                self._ball(f"object/{name}", pose.position, OBJECT, 0.006, drawn)
        for name in self._drawn - drawn:
            self._scene.remove_by_name(name)
        self._drawn = drawn

    def _way(self, case: Case, found: Attribution, drawn: set[str]) -> None:
        ticks, points = trail(case)
        if len(points) < 2:
            return
        covered = flagged_ticks(found.flagged, found.horizon, case.length + found.horizon + 1)
        red = np.array([covered[t] for t in ticks[1:]])
        colors = np.where(red[:, None], np.array(TRAIL_FLAGGED), np.array(TRAIL)).astype(np.uint8)
        self._lines("trail", points, np.repeat(colors[:, None], 2, axis=1), 0.0012, drawn)

    def _path(
        self, name: str, points: Float[np.ndarray, "N 3"], color: Sequence[int], thickness: float, drawn: set[str]
    ) -> None:
        if len(points) < 2:
            return
        colors = np.broadcast_to(np.array(color, np.uint8), (len(points) - 1, 2, 3)).copy()
        self._lines(name, points, colors, thickness, drawn)
        self._ball(f"{name}/end", points[-1], color, 1.3 * thickness, drawn)

    def _lines(
        self, name: str, points: Float[np.ndarray, "N 3"], colors: np.ndarray, thickness: float, drawn: set[str]
    ) -> None:
        segments = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
        colors = (255 * (colors / 255) ** 2.2).astype(np.uint8)  # lines' colours are taken as linear light
        self._scene.add_line_segments(f"/world/{name}", segments, colors, thickness=thickness)
        drawn.add(f"/world/{name}")

    def _ball(
        self, name: str, at: Sequence[float] | np.ndarray, color: Sequence[int], radius: float, drawn: set[str]
    ) -> None:
        r, g, b = (int(c) for c in color)
        self._scene.add_icosphere(
            f"/world/{name}", radius=radius, color=(r, g, b), position=tuple(np.asarray(at, float))
        )
        drawn.add(f"/world/{name}")
