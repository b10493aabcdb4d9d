"""From actions to poses and back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from far_app.motion import (
    ActionScale,
    TargetIntegrator,
    action_between,
    integrate,
    quat_from_rotvec,
    quat_multiply,
    rotation_between,
    rotvec_from_quat,
)
from far_app.types import Ack, Pose

unit = arrays(float, 7, elements=st.floats(-1, 1))
vectors = arrays(float, 3, elements=st.floats(-1.7, 1.7))
SCALE = ActionScale()


def pose_of(position, rotvec) -> Pose:
    return Pose(position=position, quaternion=quat_from_rotvec(rotvec))


@given(vectors)
def test_log_undoes_exp(v):
    assert np.allclose(rotvec_from_quat(quat_from_rotvec(v)), v, atol=1e-7)


@given(unit, vectors, vectors)
def test_an_action_is_recovered_from_the_poses_it_leads_between(action, position, rotvec):
    before = pose_of(position, rotvec)
    after = integrate(before, before, action, SCALE)
    assert np.allclose(action_between(before, after, action[6], SCALE), action, atol=1e-6)


@given(unit, vectors, vectors, vectors)
def test_targets_stay_on_the_leash(action, sent, measured, rotvec):
    target = integrate(pose_of(sent, rotvec), pose_of(measured, -rotvec), action, SCALE)
    assert np.linalg.norm(target.position - measured) <= SCALE.leash_translation + 1e-9
    turn = np.linalg.norm(rotation_between(quat_from_rotvec(-rotvec), target.quaternion))
    assert turn <= SCALE.leash_rotation + 1e-6


def test_full_scale_is_eight_millimetres_and_a_twentieth_of_a_radian():
    start = pose_of(np.zeros(3), np.zeros(3))
    target = integrate(start, start, np.array([1, 0, 0, 0, 0, 1, 0.0]), SCALE)
    assert target.position == pytest.approx([0.008, 0, 0])
    assert rotvec_from_quat(target.quaternion) == pytest.approx([0, 0, 0.05])


def test_the_next_target_starts_where_the_last_one_was_clipped_to():
    start = pose_of(np.zeros(3), np.zeros(3))
    integrator = TargetIntegrator(SCALE, start)
    first = integrator.target(np.array([1, 0, 0, 0, 0, 0, 1.0]), start, 1.0)
    clipped = pose_of(np.array([0.004, 0, 0]), np.zeros(3))
    executed = integrator.executed(Ack(seq=first.seq, accepted=1.0, due=1.0, pose=clipped, gripper=1.0, clipped=True))
    assert executed == pytest.approx([0.5, 0, 0, 0, 0, 0, 1])
    second = integrator.target(np.array([1, 0, 0, 0, 0, 0, 1.0]), start, 2.0)
    assert second.pose.position[0] == pytest.approx(0.012)


def test_quaternion_products_compose_rotations():
    a, b = np.array([0.3, 0, 0]), np.array([0.4, 0, 0])
    assert rotvec_from_quat(quat_multiply(quat_from_rotvec(a), quat_from_rotvec(b))) == pytest.approx([0.7, 0, 0])
