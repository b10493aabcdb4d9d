"""The compiled law is the one that is written down, and the error is a rotation vector from any pose to any other."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hw.osc import DAMPING, derive, impedance, pose_error

RNG = np.random.default_rng(0)


def some_turns() -> list[Rotation]:
    half = [Rotation.from_rotvec(np.pi * axis) for axis in np.eye(3)]
    return [Rotation.identity(), *half, *Rotation.random(20, random_state=1)]


@pytest.mark.parametrize("goal", some_turns())
def test_the_error_leads_to_the_goal(goal):
    x, y, z, w = goal.as_quat()
    for here in some_turns():
        at, to, error = RNG.normal(size=3), RNG.normal(size=3), np.empty(6)
        pose_error(to, np.array([w, x, y, z]), at, here.as_matrix().ravel().copy(), error)
        assert np.allclose(at + error[:3], to)
        assert np.linalg.norm(error[3:]) <= np.pi + 1e-9
        assert (Rotation.from_rotvec(error[3:]) * here * goal.inv()).magnitude() < 1e-6


def test_the_torques_are_the_law():
    jacobian, root = RNG.normal(size=(6, 7)), RNG.normal(size=(7, 7))
    mass = root @ root.T + np.eye(7)
    gain, nullspace, torques = np.empty((7, 6)), np.empty((7, 7)), np.empty(7)
    derive(jacobian, mass, gain, nullspace)
    error, velocity, away, bias = RNG.normal(size=6), RNG.normal(size=7), RNG.normal(size=7), RNG.normal(size=7)
    kp, kd, kn, kdn = 600.0, 49.0, 10.0, 6.3
    impedance(error, velocity, away, bias, jacobian, gain, nullspace, kp, kd, kn, kdn, torques)

    inverse = np.linalg.inv(mass)
    weight = np.linalg.inv(jacobian @ inverse @ jacobian.T + DAMPING * np.eye(6))
    back = inverse @ jacobian.T @ weight
    hand = jacobian.T @ weight @ (kp * error - kd * jacobian @ velocity)
    posture = (np.eye(7) - jacobian.T @ back.T) @ mass @ (kn * away - kdn * velocity)
    assert np.allclose(torques, hand + bias + posture)
