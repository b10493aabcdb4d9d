"""What a convolutional layer does besides its product, each in one pass over memory: on CPU, float32, without Python's
lock.

    norm_mish    GroupNorm → Mish [→ FiLM]
    taps         every step beside its neighbours, ready for the product
    two_step     a convolution over two steps as one matrix

torch does the same in eight passes, each with a tensor of its own. Compiled once, when first imported on a machine, and
kept in __pycache__ (a few seconds). The layers (layers.py) run them; tests hold them to torch's own operations.
"""

from __future__ import annotations

import numpy as np
from numba import njit

f32 = np.float32
FAST = {"nogil": True, "error_model": "numpy", "cache": True}
"""No liberties with rounding: which of its loops the compiled code takes depends on where the heap has put the arrays,
and all of them must give the same to the bit. A NaN passes through, too."""

ZERO, HALF, ONE, TWO = f32(0.0), f32(0.5), f32(1.0), f32(2.0)
TANH_IS_ONE = f32(7.9)
"""From here on tanh is 1 in float32."""


@njit(inline="always")
def _logistic_of_opposite(x):  # noqa: ANN001, ANN202
    """q = σ(−x) = (1 − tanh(x/2)) / 2, tanh as a quotient of polynomials (minimax; those that Eigen uses)."""
    h = HALF * x
    h = h if h < TANH_IS_ONE else TANH_IS_ONE
    h = h if h > -TANH_IS_ONE else -TANH_IS_ONE
    s = h * h
    p = f32(-2.76076847742355e-16) * s + f32(2.00018790482477e-13)
    p = p * s + f32(-8.60467152213735e-11)
    p = p * s + f32(5.12229709037114e-08)
    p = p * s + f32(1.48572235717979e-05)
    p = p * s + f32(6.37261928875436e-04)
    p = p * s + f32(4.89352455891786e-03)
    q = f32(1.19825839466702e-06) * s + f32(1.18534705686654e-04)
    q = q * s + f32(2.26843463243900e-03)
    q = q * s + f32(4.89352518554385e-03)
    return HALF - HALF * (h * p / q)


@njit(
    "void(f4[:,:,::1], f4[::1], f4[::1], f4, f4[:,::1], i8, f4[:,:,::1], f4[:,::1], f4[:,::1])", **FAST
)  # fmt: skip
def norm_mish(x, scale, offset, eps, film, at, out, mean, rstd):  # noqa: ANN001, ANN201, PLR0913
    """y = mish(GroupNorm(x)), with FiLM y · film[at : at + C] + film[at + C : at + 2C] where `at` ≥ 0.

    x, out (B, T, C); scale, offset (C); film (B, M); mean, rstd (B, G), of each group, for `norm_mish_back`."""
    batch, length, channels = x.shape
    groups = mean.shape[1]
    width = channels // groups
    share = ONE / f32(length * width)
    total, slope, start = np.empty(channels, f32), np.empty(channels, f32), np.empty(channels, f32)
    for b in range(batch):
        total[:] = x[b, 0]
        for t in range(1, length):
            for c in range(channels):
                total[c] += x[b, t, c]
        for g in range(groups):
            m = ZERO
            for c in range(g * width, (g + 1) * width):
                m += total[c]
            mean[b, g] = m * share
            start[g * width : (g + 1) * width] = m * share
        total[:] = ZERO
        for t in range(length):
            for c in range(channels):
                d = x[b, t, c] - start[c]
                total[c] += d * d
        for g in range(groups):
            v = ZERO
            for c in range(g * width, (g + 1) * width):
                v += total[c]
            r = ONE / np.sqrt(v * share + eps)
            rstd[b, g] = r
            for c in range(g * width, (g + 1) * width):
                slope[c] = scale[c] * r
                start[c] = offset[c] - mean[b, g] * slope[c]
        for t in range(length):
            if at >= 0:
                for c in range(channels):
                    z = x[b, t, c] * slope[c] + start[c]
                    q = _logistic_of_opposite(z)
                    out[b, t, c] = z * (TWO / (ONE + q * q) - ONE) * film[b, at + c] + film[b, at + channels + c]
            else:
                for c in range(channels):
                    z = x[b, t, c] * slope[c] + start[c]
                    q = _logistic_of_opposite(z)
                    out[b, t, c] = z * (TWO / (ONE + q * q) - ONE)


@njit(
    "void(f4[:,:,::1], f4[:,:,::1], f4[::1], f4[::1], f4[:,::1], f4[:,::1], f4[:,::1], i8, f4[:,:,::1], f4[::1], "
    "f4[::1], f4[:,::1])", **FAST
)  # fmt: skip
def norm_mish_back(g, x, scale, offset, mean, rstd, film, at, to_x, to_scale, to_offset, to_film):  # noqa: ANN001, ANN201, PLR0913
    """The gradients of norm_mish, given the output's: written to to_x and to to_film's columns, set in to_scale and
    to_offset.

    With x̂ the normalised input, z = scale · x̂ + offset, q = σ(−z) and r = 2 / (1 + q²), mish(z) = z (r − 1) and
    mish′(z) = r (1 + z q² (1 − q) r) − 1; and for d the gradient on z, GroupNorm's is
    rstd · (scale d − mean_g(scale d) − x̂ mean_g(scale d x̂))."""
    batch, length, channels = x.shape
    groups = mean.shape[1]
    width = channels // groups
    share = ONE / f32(length * width)
    slope, start, middle = np.empty(channels, f32), np.empty(channels, f32), np.empty(channels, f32)
    flat, along = np.empty(channels, f32), np.empty(channels, f32)
    to_gain, to_shift = np.empty(channels, f32), np.empty(channels, f32)
    gain = np.ones(channels, f32)
    to_scale[:] = ZERO
    to_offset[:] = ZERO
    for b in range(batch):
        for k in range(groups):
            for c in range(k * width, (k + 1) * width):
                middle[c] = mean[b, k]
                slope[c] = scale[c] * rstd[b, k]
                start[c] = offset[c]
        flat[:], along[:], to_gain[:], to_shift[:] = ZERO, ZERO, ZERO, ZERO
        if at >= 0:
            gain[:] = film[b, at : at + channels]
        for t in range(length):
            for c in range(channels):
                d = x[b, t, c] - middle[c]
                z = d * slope[c] + start[c]
                q = _logistic_of_opposite(z)
                r = TWO / (ONE + q * q)
                given = g[b, t, c]
                to_gain[c] += given * (z * (r - ONE))
                to_shift[c] += given
                down = given * gain[c] * (r * (ONE + z * (q * q) * (ONE - q) * r) - ONE)
                flat[c] += down
                along[c] += down * d
                to_x[b, t, c] = down
        if at >= 0:
            to_film[b, at : at + channels] = to_gain
            to_film[b, at + channels : at + 2 * channels] = to_shift
        for k in range(groups):
            r = rstd[b, k]
            mean_flat, mean_along = ZERO, ZERO
            for c in range(k * width, (k + 1) * width):
                to_scale[c] += along[c] * r
                to_offset[c] += flat[c]
                mean_flat += flat[c] * scale[c]
                mean_along += along[c] * scale[c]
            for c in range(k * width, (k + 1) * width):
                flat[c] = r * share * mean_flat
                along[c] = r * r * r * share * mean_along
        for t in range(length):
            for c in range(channels):
                to_x[b, t, c] = to_x[b, t, c] * slope[c] - flat[c] - (x[b, t, c] - middle[c]) * along[c]


@njit("void(f4[:,:,::1], i8, f4[:,:,:,::1])", **FAST)
def taps(x, stride, out):  # noqa: ANN001, ANN201
    """out[b, i] = x[b, i·stride − 1 … i·stride + 1]; zeros past the ends. x (B, T, C), out (B, T/stride, C, 3)."""
    batch, length, channels = x.shape
    nothing = np.zeros(channels, f32)
    for b in range(batch):
        for i in range(out.shape[1]):
            t = i * stride
            before = x[b, t - 1] if t > 0 else nothing
            after = x[b, t + 1] if t + 1 < length else nothing
            for c in range(channels):
                out[b, i, c, 0] = before[c]
                out[b, i, c, 1] = x[b, t, c]
                out[b, i, c, 2] = after[c]


@njit("void(f4[:,:,:,::1], i8, f4[:,:,::1])", **FAST)
def taps_back(g, stride, to_x):  # noqa: ANN001, ANN201
    """The gradient of `taps`, given the output's."""
    batch, length, channels = to_x.shape
    for b in range(batch):
        to_x[b] = ZERO
        for i in range(g.shape[1]):
            t = i * stride
            for c in range(channels):
                to_x[b, t, c] += g[b, i, c, 1]
            if t > 0:
                for c in range(channels):
                    to_x[b, t - 1, c] += g[b, i, c, 0]
            if t + 1 < length:
                for c in range(channels):
                    to_x[b, t + 1, c] += g[b, i, c, 2]


@njit("void(f4[:,:,::1], f4[:,::1])", **FAST)
def two_step(weight, out):  # noqa: ANN001, ANN201
    """A kernel-3 convolution (O, C, 3) over two steps as one matrix (2O, 2C): [[W₁ W₂], [W₀ W₁]]."""
    outer, inner, _ = weight.shape
    for o in range(outer):
        for c in range(inner):
            out[o, c] = weight[o, c, 1]
            out[o, inner + c] = weight[o, c, 2]
            out[outer + o, c] = weight[o, c, 0]
            out[outer + o, inner + c] = weight[o, c, 1]


@njit("void(f4[:,::1], f4[:,:,::1])", **FAST)
def two_step_back(g, to_weight):  # noqa: ANN001, ANN201
    """The gradient of `two_step`, given the matrix's."""
    outer, inner, _ = to_weight.shape
    for o in range(outer):
        for c in range(inner):
            to_weight[o, c, 0] = g[outer + o, c]
            to_weight[o, c, 1] = g[o, c] + g[outer + o, inner + c]
            to_weight[o, c, 2] = g[o, inner + c]
