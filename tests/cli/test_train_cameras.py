"""`far train policy` on whole frames of a rig's camera: one view, cut as live, and a card that the preflight reads."""

from __future__ import annotations

import numpy as np

from far_app.cli import main
from far_app.cli.preflight import preflight
from far_app.learning.dataset import Episode, write_episode
from far_app.learning.policy import load_policy, read_card, trained_framings
from far_app.preflight import setup_from
from far_app.tasks import task
from hw.camera_config import with_views
from hw.rig import load_rig
from hw.setup import setup_of
from tests.test_preflight import SPEC, observation


def test_the_papers_rig_trains_one_view_and_its_card_fits_the_rig(tmp_path):
    rng, rig = np.random.default_rng(0), load_rig("paper")
    data = tmp_path / "raw.hdf5"
    for seed in range(2):
        write_episode(data, Episode(
            images={"front": rng.integers(0, 256, (12, 720, 2560, 3), np.uint8)},
            states=rng.normal(size=(12, 8)).astype(np.float32), actions=rng.uniform(-1, 1, (12, 7)).astype(np.float32),
            rewards=np.zeros(12, np.float32), successes=np.zeros(12, bool), success=True, seed=seed,
        ), {"env_name": "Lift"})  # fmt: skip
    assert main(["train", "policy", "--data", str(data), "--rig", "paper", "--cameras", "front", "--iterations", "1",
                 "--out", str(tmp_path), "--threads", "1"]) == 0  # fmt: skip
    path = tmp_path / "policy.safetensors"
    assert load_policy(path).config.cameras == ("front",)
    here = setup_of(rig, with_views(task("lift"), rig.cameras))
    card = read_card(path)
    assert setup_from(card["setup"]) == here
    assert trained_framings(path)["front"].crop == (280, 0, 720, 720)
    preflight(SPEC, card, here, observation(front=rng.integers(0, 256, (84, 84, 3), np.uint8)), accepted=False)
