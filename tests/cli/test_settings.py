"""What a checkpoint recommends is where a command begins; the command line has the last word."""

from pathlib import Path

import pytest

from far_app.cli.options import RunOptions
from far_app.cli.settings import parse, recommend, recommended
from far_app.config import FCPAConfig, RetryConfig
from far_app.errors import ConfigError
from far_app.tasks import repeats


@pytest.fixture
def checkpoint(tmp_path):
    (tmp_path / "retry.toml").write_text('[fcpa]\nlr = 2e-6\nguard = "scale"\n')
    return str(tmp_path / "policy.safetensors")


def test_the_models_settings_come_first_and_the_command_line_last(checkpoint):
    options = parse(RunOptions, ["--policy", checkpoint, "--retry.fcpa.guard", "stop", "--trials", "3"], "far run")
    assert options.retry == RetryConfig(fcpa=FCPAConfig(lr=2e-6, guard="stop"))
    assert options.trials == 3


def test_the_papers_settings_are_one_option_away(checkpoint):
    options = parse(RunOptions, ["--policy", checkpoint, "--settings", "paper"], "far run")
    assert options.retry == RetryConfig()


def test_a_checkpoint_without_a_recommendation_begins_from_the_papers(tmp_path):
    assert recommended("lift", tmp_path / "policy.safetensors") == RetryConfig()
    assert recommended("lift", "untrained:paper") == RetryConfig()


@pytest.mark.parametrize(
    ("text", "says"), [("[fcpa]\nrate = 1", "retry.toml.fcpa: unknown setting rate"), ("[", "TOML")]
)
def test_a_wrong_recommendation_is_named(tmp_path, text, says):
    (tmp_path / "retry.toml").write_text(text)
    with pytest.raises(ConfigError, match=says):
        recommended("lift", tmp_path / "policy.safetensors")


@pytest.mark.parametrize("preset", ["state", "quickstart"])
def test_a_new_checkpoint_gets_what_is_known_of_such_policies(tmp_path, preset):
    checkpoint = tmp_path / "policy.safetensors"
    assert recommend(checkpoint, preset) == tmp_path / "retry.toml"
    found = recommended("can", checkpoint)
    assert (found.pairs.explore, found.fcpa.guard, found.perturbation.first_attempt) == (0.15, "bc", 3)


def test_the_shipped_model_has_what_a_new_one_would_get(tmp_path):
    recommend(tmp_path / "policy.safetensors", "quickstart")
    assert recommended("lift", None) == recommended("lift", tmp_path / "policy.safetensors")


def test_candidates_explore_by_as_many_millimetres_where_actions_are_repeated(tmp_path):
    recommend(tmp_path / "policy.safetensors", "state", repeats("door", "panda"))
    assert recommended("door", tmp_path / "policy.safetensors").pairs.explore == 0.05


def test_a_recommendation_that_is_there_already_stays(checkpoint):
    assert recommend(Path(checkpoint), "state") is None
    assert recommended("lift", checkpoint).fcpa.lr == 2e-6


def test_nothing_is_recommended_where_nothing_measured_best(tmp_path):
    assert recommend(tmp_path / "policy.safetensors", "paper") is None
