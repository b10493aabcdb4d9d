"""docs/data.md describes everything that is exported."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from far_app.exchange.lerobot import columns_of, features_of
from far_app.exchange.rollout import COLUMNS, Provenance
from far_app.exchange.select import Selection, rollouts
from tests.recording import sessions

TEXT = (Path(__file__).parents[2] / "docs/data.md").read_text()


def test_every_feature_and_every_fact_of_an_episode_is_described(tmp_path):
    one = next(rollouts([sessions.small_session(tmp_path, steps=2)], Selection(), print))
    assert set(one.columns) == set(COLUMNS)
    named = [name.replace("images.front", "images.CAMERA") for name in features_of(one) if "wrist" not in name]
    assert set(columns_of(one)) <= set(features_of(one))
    assert [name for name in named if f"`{name}`" not in TEXT] == []
    assert [f.name for f in fields(Provenance) if f"`far/{f.name}`" not in TEXT] == []
