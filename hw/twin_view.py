"""What the twin's cameras see: its own MuJoCo model with decimated visual meshes, drawn by one EGL context a thread.

Software rendering is bound by vertices (119,000 faces, most of them the arm's) and by shadows, reflections and
multisampling; without them and with each mesh thinned once (hw/thin_meshes.py), two 84 × 84 pictures cost 6 ms instead
of 65.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco
import numpy as np
from jaxtyping import Bool, Float, UInt8

from far_app.errors import GraphicsError
from far_app.motion import quat_inverse, quat_multiply
from far_app.telemetry import BodyMesh, SceneGeometry
from far_app.types import Pose
from hw.solids import box, cylinder
from hw.thin_meshes import FACE_BUDGET, thin_meshes

VISUAL, HIDDEN = 1, 5
"""Geom groups: robosuite's of what is drawn, and one that never is."""
WITHOUT = (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_SKYBOX)
"""What is not drawn. The sky: walls hide it, but every pixel of it would be drawn before them."""


@dataclass(frozen=True, kw_only=True)
class CameraPlacement:
    """A camera of the twin: fixed in the world, or on a body."""

    position: tuple[float, float, float]
    """Metres, in the parent's frame."""
    target: tuple[float, float, float]
    """The point it looks at, same frame."""
    up: tuple[float, float, float]
    fovy: float
    """Vertical field of view, degrees."""
    body: str = "world"


def look_at(camera: CameraPlacement) -> Float[np.ndarray, "4"]:
    """Orientation (wxyz, MuJoCo) of a camera that looks along −z with y up."""
    back = np.subtract(camera.position, camera.target)
    back = back / np.linalg.norm(back)
    right = np.cross(camera.up, back)
    right = right / np.linalg.norm(right)
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.column_stack([right, np.cross(back, right), back]).ravel())
    return quaternion


def visual_model(
    xml: str, cameras: Mapping[str, CameraPlacement], budget: int | None = FACE_BUDGET
) -> mujoco.MjModel:  # fmt: skip
    """The scene for drawing only: thinned meshes, our cameras, no shadows, reflections or multisampling. Without a
    budget the meshes stay whole: what the thinned ones are compared with."""
    spec = mujoco.MjSpec.from_string(xml)
    if budget is not None:
        thin_meshes(spec, budget)
    for name, camera in cameras.items():
        body = spec.body(camera.body)
        body.add_camera(name=name, pos=camera.position, quat=look_at(camera), fovy=camera.fovy)
    model = spec.compile()
    model.vis.quality.offsamples = 0
    model.vis.quality.shadowsize = 0
    return model


class TwinView:
    """A PlantView (hw/plant.py) of TwinPlant's snapshots. Make and use it in one thread."""

    def __init__(
        self, xml: str, base: Pose, cameras: Mapping[str, CameraPlacement], budget: int | None = FACE_BUDGET
    ) -> None:
        """`budget`: faces kept of each mesh; None keeps all."""
        self._model = visual_model(xml, cameras, budget)
        self._data = mujoco.MjData(self._model)
        self._base = base
        self._renderers: dict[int, mujoco.Renderer] = {}
        self._drawn: Any = None
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 0
        self._options.geomgroup[VISUAL] = 1
        self._options.sitegroup[:] = 0
        self._visual = self._model.geom_group == VISUAL

    @property
    def faces(self) -> int:
        """Triangles of all meshes."""
        return int(self._model.nmeshface)

    def _renderer(self, size: int) -> mujoco.Renderer:
        if size not in self._renderers:
            # its frame buffer, all of which is cleared for each picture
            self._model.vis.global_.offwidth = self._model.vis.global_.offheight = size
            try:
                renderer = mujoco.Renderer(self._model, size, size)
            except Exception as error:  # MuJoCo raises whatever its GL back end raised
                raise GraphicsError(
                    f"no {os.environ.get('MUJOCO_GL', 'egl')} context of {size}×{size} could be made ({error}); "
                    "install libegl1 and libgl1-mesa-dri (Debian), or set MUJOCO_GL=osmesa with libosmesa6"
                ) from error
            for flag in WITHOUT:
                renderer.scene.flags[flag] = 0
            self._renderers[size] = renderer
        return self._renderers[size]

    def _place(self, snapshot: Any) -> None:
        if snapshot is not self._drawn:
            self._data.qpos[:] = snapshot.qpos
            self._model.body_pos[:] = snapshot.body_pos  # a scene may move what is not a joint (a door, a bin)
            self._model.body_quat[:] = snapshot.body_quat
            mujoco.mj_kinematics(self._model, self._data)
            mujoco.mj_camlight(self._model, self._data)
            self._drawn = snapshot

    def image(self, snapshot: Any, camera: str, size: int) -> UInt8[np.ndarray, "size size 3"]:
        self._place(snapshot)
        self._model.geom_group[self._visual] = np.where(self._in_sight(camera), VISUAL, HIDDEN)
        renderer = self._renderer(size)
        renderer.update_scene(self._data, camera, scene_option=self._options)
        return renderer.render()

    def _in_sight(self, camera: str) -> Bool[np.ndarray, "V"]:
        """Which of the visual geoms may be in a camera's (square) picture, by their bounding spheres. The wrist's
        camera has most of the arm behind it, and software draws what it then throws away."""
        model, data, i = self._model, self._data, self._model.camera(camera).id
        radius = model.geom_rbound[self._visual]
        seen = (data.geom_xpos[self._visual] - data.cam_xpos[i]) @ data.cam_xmat[i].reshape(3, 3)
        half = np.deg2rad(model.cam_fovy[i]) / 2
        beside = np.abs(seen[:, :2]) * np.cos(half) + seen[:, 2:] * np.sin(half)  # of the planes at the picture's edges
        return (radius == 0) | ((beside.max(axis=1) < radius) & (seen[:, 2] < radius))  # 0: a plane's, without end

    def body_poses(self, snapshot: Any) -> Float[np.ndarray, "B 7"]:
        self._place(snapshot)
        inverse = quat_inverse(self._base.quaternion)
        poses = np.empty((self._model.nbody, 7))
        for i in range(self._model.nbody):
            offset = np.append(self._data.xpos[i] - self._base.position, 0.0)
            poses[i, :3] = quat_multiply(quat_multiply(inverse, offset), self._base.quaternion)[:3]
            poses[i, 3:] = quat_multiply(inverse, self._data.xquat[i][[1, 2, 3, 0]])
        return poses

    def geometry(self) -> SceneGeometry:
        meshes = tuple(mesh for geom in range(self._model.ngeom) if (mesh := self._geom_mesh(geom)) is not None)
        names = tuple(self._model.body(i).name for i in range(self._model.nbody))
        return SceneGeometry(meshes=meshes, body_names=names)

    def _geom_mesh(self, geom: int) -> BodyMesh | None:
        """A visual geom as a triangle mesh in its body's frame; floor and walls are left out."""
        model = self._model
        kind, size = model.geom_type[geom], model.geom_size[geom]
        if not self._visual[geom]:
            return None
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            v0, f0 = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
            vertices = model.mesh_vert[v0 : v0 + model.mesh_vertnum[mesh]]
            faces = model.mesh_face[f0 : f0 + model.mesh_facenum[mesh]]
        elif kind == mujoco.mjtGeom.mjGEOM_BOX:
            vertices, faces = box(size)
        elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
            vertices, faces = cylinder(size[0], size[1])
        else:
            return None
        if model.geom_bodyid[geom] == 0:
            return None
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        placed = np.asarray(vertices) @ rotation.reshape(3, 3).T + model.geom_pos[geom]
        red, green, blue, alpha = self._color(geom)
        return BodyMesh(
            body=int(model.geom_bodyid[geom]), vertices=placed.astype(np.float32), faces=np.asarray(faces, np.int32),
            rgba=(red, green, blue, alpha),
        )  # fmt: skip

    def _color(self, geom: int) -> tuple[float, ...]:
        """A geom's colour, its texture averaged (the page draws no textures)."""
        model = self._model
        material = model.geom_matid[geom]
        if material < 0:
            return tuple(float(c) for c in model.geom_rgba[geom])
        rgba = np.array(model.mat_rgba[material], dtype=float)
        texture = model.mat_texid[material][mujoco.mjtTextureRole.mjTEXROLE_RGB]
        if texture >= 0:
            start, channels = model.tex_adr[texture], model.tex_nchannel[texture]
            pixels = model.tex_data[start : start + channels * model.tex_width[texture] * model.tex_height[texture]]
            rgba[:3] *= pixels.reshape(-1, channels)[:, :3].mean(axis=0) / 255
        return tuple(float(c) for c in rgba)

    def close(self) -> None:
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()
