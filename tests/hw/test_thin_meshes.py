"""Thinned meshes: the cached ones are the made ones, a changed file never finds an old one, no cache is no harm."""

import logging

import mujoco
import numpy as np
import pytest
import trimesh

from hw import thin_meshes
from hw.solids import box, cylinder
from hw.thin_meshes import made, thinned


@pytest.fixture
def ball(tmp_path):
    file = tmp_path / "ball.stl"
    trimesh.creation.icosphere(subdivisions=4).export(file)
    return file


def test_a_cached_mesh_is_the_made_one_to_the_last_bit(ball, tmp_path, monkeypatch):
    cache = tmp_path / "cache"
    first = thinned(ball, 200, cache)
    monkeypatch.setattr(thin_meshes, "made", lambda *_: pytest.fail("made again"))
    again = thinned(ball, 200, cache)
    for one, kept, fresh in zip(first, again, made(ball, 200), strict=True):
        assert one.dtype == kept.dtype == fresh.dtype
        assert np.array_equal(one, kept) and np.array_equal(one, fresh)
    assert 150 <= len(first[1]) <= 200
    assert not list(cache.glob("*partial*"))


def test_another_file_another_budget_or_a_damaged_cache_is_made_anew(ball, tmp_path):
    cache = tmp_path / "cache"
    faces = {budget: len(thinned(ball, budget, cache)[1]) for budget in (100, 200)}
    assert faces[100] < faces[200]
    trimesh.creation.box().export(ball)
    assert len(thinned(ball, 200, cache)[1]) == 12
    for kept in cache.iterdir():
        kept.write_bytes(kept.read_bytes()[:40])
    assert len(thinned(ball, 200, cache)[1]) == 12
    with np.load(max(cache.iterdir(), key=lambda f: f.stat().st_mtime)) as arrays:
        assert len(arrays["faces"]) == 12


def test_a_cache_that_cannot_be_written_costs_time_only(ball, tmp_path, caplog):
    (tmp_path / "cache").write_text("a file where the folder should be")
    with caplog.at_level(logging.INFO):
        assert len(thinned(ball, 200, tmp_path / "cache")[1]) <= 200
    assert "are not kept in" in caplog.text


def test_a_model_draws_the_thinned_mesh(ball, tmp_path):
    geom = '<geom type="mesh" mesh="ball"/>'
    xml = f'<mujoco><asset><mesh name="ball" file="{ball}"/></asset><worldbody>{geom}</worldbody></mujoco>'
    spec = mujoco.MjSpec.from_string(xml)
    thin_meshes.thin_meshes(spec, 200, tmp_path / "cache")
    assert spec.compile().nmeshface <= 200


@pytest.mark.parametrize("solid, size", [(box(np.array([1, 2, 3])), (2, 4, 6)), (cylinder(2.0, 3.0), (4, 4, 6))])
def test_solids_are_closed_face_outwards_and_have_their_size(solid, size):
    shape = trimesh.Trimesh(*solid, process=False)
    assert shape.is_watertight and shape.is_winding_consistent and shape.volume > 0
    assert shape.extents == pytest.approx(size, rel=1e-2)
