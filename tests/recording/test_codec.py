"""Every value comes back from JSON as it went in, and the schemas describe what is written."""

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from far_app.errors import RecordingError
from far_app.recording.codec import codec, decode, plain
from far_app.recording.schema import json_schemas
from far_app.types import ActionChunk, Adaptation, AdaptationStep, Outcome, Pose, Step

from . import values

floats = st.floats(allow_nan=True, allow_infinity=True)


def arrays(*shape: int, dtype: Any = np.float64) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(dtype, shape)


def through_json(hint: Any, value: Any) -> Any:
    return decode(hint, json.loads(json.dumps(codec(hint).encode(value), allow_nan=False)), "a value")


@settings(deadline=None)
@given(floats)
def test_a_float_survives_exactly_with_nan_and_infinities(value: float) -> None:
    back = through_json(float, value)
    assert back == value or (math.isnan(back) and math.isnan(value))


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 20).flatmap(arrays))
def test_a_vector_survives_exactly(array: np.ndarray) -> None:
    back = through_json(np.ndarray, array)
    assert back.shape == array.shape
    np.testing.assert_array_equal(back, array)


@settings(max_examples=30, deadline=None)
@given(
    actions=arrays(8, 7),
    candidates=st.none() | arrays(3, 8, 7, dtype=np.float32),
    value=floats,
    version=st.text(),
)
def test_a_chunk_survives_exactly(actions: Any, candidates: Any, value: float, version: str) -> None:
    chunk = ActionChunk(tick=4, actions=actions, policy_version=version, value=value, candidates=candidates)
    assert values.same(through_json(ActionChunk, chunk), chunk)


@settings(max_examples=30, deadline=None)
@given(
    numbers=st.integers(8, 40).flatmap(arrays),
    flagged=st.lists(st.integers(0, 1000)),
    threshold=floats,
    losses=st.lists(floats, max_size=4),
    seconds=st.dictionaries(st.text(), floats, max_size=3),
    note=st.text(),
)
def test_an_adaptation_survives_exactly(
    numbers: Any, flagged: list[int], threshold: float, losses: list[float], seconds: dict[str, float], note: str
) -> None:
    history = tuple(
        AdaptationStep(step=k, steps=10, loss=loss, winner_error=loss, loser_error=-loss)
        for k, loss in enumerate(losses)
    )
    adaptation = Adaptation(
        status="adapted", base_version="a", version="b", values=numbers, value_changes=numbers[8:], threshold=threshold,
        flagged=tuple(flagged), pairs=3, history=history, seconds=seconds, note=note,
    )  # fmt: skip
    assert values.same(through_json(Adaptation, adaptation), adaptation)


def test_numpy_scalars_are_recorded_as_numbers() -> None:
    step = values.step(np.int64(3), value=np.float32(0.5), success=np.bool_(True))  # pyright: ignore[reportArgumentType]
    back = codec(Step).encode(step)
    assert (back["tick"], back["value"], back["success"]) == (3, 0.5, True)
    json.dumps(back["tick"])


def test_a_wrong_dimension_is_refused() -> None:
    with pytest.raises(TypeError, match="where 1 dimensions are recorded"):
        codec(Pose).encode(Pose(position=np.zeros((2, 3)), quaternion=np.zeros(4)))


@pytest.mark.parametrize("body", [None, 3, {}, {"success": True}, {"success": True, "judged_by": "the moon"}])
def test_json_of_another_shape_is_refused_by_name(body: Any) -> None:
    with pytest.raises(RecordingError, match=r"/outcome does not fit its schema"):
        decode(Outcome, body, "/outcome")


def test_a_field_added_later_reads_as_its_default() -> None:
    body = codec(Outcome).encode(values.attempt(1, 1).outcome)
    del body["note"]
    assert decode(Outcome, body, "/outcome").note == ""


def test_settings_become_plain_json() -> None:
    text = json.dumps(plain({"a": (1, np.float32(2.5)), "b": values.adaptation(10), "c": math.nan}), allow_nan=False)
    assert json.loads(text)["a"] == [1, 2.5]
    with pytest.raises(TypeError, match="object has no form in a recording"):
        plain(object())


def test_schemas_keep_to_what_viewers_accept() -> None:
    """Plain types, no lists of lists, properties for every object that a viewer walks into."""

    def check(part: Any, where: str) -> None:
        kind = part["type"]
        assert kind in ("object", "array", "string", "number", "integer", "boolean"), where
        if kind == "array":
            assert part["items"]["type"] != "array", where
            check(part["items"], f"{where}[]")
        if kind == "object":
            for name, inner in part["properties"].items():
                check(inner, f"{where}.{name}")

    for topic, schema in json_schemas().items():
        check(schema, topic)
