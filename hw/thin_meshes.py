"""The arm's visual meshes with a few hundred triangles each, made once and kept in the user's cache.

Made from the model's own files by quadric decimation; a cached mesh is the made one to the last bit, so that pictures
of datasets, trainings and live runs are the same whoever draws them first. The name of a cached file is the hash of all
that it depends on: a changed mesh, budget or method never finds an old one.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import logging
import os
import zipfile
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float32, Int32

log = logging.getLogger(__name__)

FACE_BUDGET = 400
"""Faces kept of each visual mesh."""
MUJOCO_S_OWN = ".msh"
"""A format only MuJoCo reads (can, bread, milk): such meshes are small, and stay as they are."""
MADE_BY = ("fast-simplification", "trimesh", "numpy")
"""Packages whose versions may change a made mesh."""

Mesh = tuple[Float32[np.ndarray, "V 3"], Int32[np.ndarray, "F 3"]]


def thin_meshes(spec: mujoco.MjSpec, budget: int = FACE_BUDGET, folder: Path | None = None) -> None:
    """Replace every visual mesh by one of about `budget` faces; textures of primitives stay. `folder`: the cache, the
    user's by default."""
    folder = folder or cache_folder()
    for mesh in spec.meshes:
        if not mesh.file or mesh.file.endswith(MUJOCO_S_OWN):
            continue
        vertices, faces = thinned(Path(mesh.file), budget, folder)
        mesh.file = ""
        mesh.uservert = vertices.astype(float).ravel()
        mesh.userface = faces.ravel()


def thinned(file: Path, budget: int, folder: Path) -> Mesh:
    """From the cache, or made and put there; a cache that cannot be read or written costs time and nothing else."""
    kept = folder / f"{_key(file, budget)}.npz"
    with contextlib.suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile), np.load(kept) as arrays:
        return arrays["vertices"], arrays["faces"]
    vertices, faces = made(file, budget)
    partial = kept.with_name(f"{kept.stem}-{os.getpid()}.partial.npz")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(partial, vertices=vertices, faces=faces)
        partial.replace(kept)
    except OSError as error:
        log.info("the thinned meshes are not kept in %s: %s", folder, error)
    return vertices, faces


def made(file: Path, budget: int) -> Mesh:
    """Quadric decimation of a mesh file."""
    import fast_simplification
    import trimesh

    shape: Any = trimesh.load(file, force="mesh", process=True)
    shape.merge_vertices(merge_tex=True, merge_norm=True)
    vertices: Any = np.asarray(shape.vertices, np.float32)
    faces: Any = np.asarray(shape.faces, np.int32)
    if len(faces) > budget:
        vertices, faces, *_ = fast_simplification.simplify(vertices, faces, target_count=budget)
    return np.asarray(vertices, np.float32), np.asarray(faces, np.int32)


def cache_folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "far" / "meshes"


def _key(file: Path, budget: int) -> str:
    return hashlib.sha256(file.read_bytes() + f"{budget} {_makers()}".encode()).hexdigest()[:32]


@cache
def _makers() -> str:
    return " ".join(f"{name} {importlib.metadata.version(name)}" for name in MADE_BY)
