import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zestjax.nets.conv3d import conv3d, conv3d_transpose

SIZES = [(3, 4, 5, 2, 6), (5, 2, 1, 3, 2)]  # more channels out than in, and fewer; odd, even and single sizes


def volume_and_kernel(d, h, w, n_in, n_out, dtype: type = np.float32):
    rng = np.random.default_rng(d + 10 * h)
    return rng.normal(size=(d, h, w, n_in)).astype(dtype), rng.normal(size=(3, 3, 3, n_in, n_out)).astype(dtype)


def conv3d_by_loops(x, kernel, stride):
    size = [-(-n // stride) for n in x.shape[:3]]
    out = np.zeros((*size, kernel.shape[-1]))
    for cell in np.ndindex(*size):
        for tap in np.ndindex(3, 3, 3):
            at = tuple(stride * c + t - 1 for c, t in zip(cell, tap, strict=True))
            if all(0 <= a < n for a, n in zip(at, x.shape[:3], strict=True)):
                out[cell] += x[at] @ kernel[tap]
    return out


def transpose_by_loops(x, kernel):
    size = [2 * n for n in x.shape[:3]]
    out = np.zeros((*size, kernel.shape[-1]))
    for cell in np.ndindex(*x.shape[:3]):
        for tap in np.ndindex(3, 3, 3):
            at = tuple(2 * c + t - 1 for c, t in zip(cell, tap, strict=True))
            if all(0 <= a < n for a, n in zip(at, size, strict=True)):
                out[at] += x[cell] @ kernel[tap]
    return out


@pytest.mark.parametrize("lowering", ["plain", "folded"])
def test_agrees_with_loops_in_float64(x64, lowering):
    x, kernel = volume_and_kernel(3, 4, 3, 3, 2, np.float64)
    for stride in (1, 2):
        ours = conv3d(x, kernel, stride=stride, lowering=lowering)
        np.testing.assert_allclose(ours, conv3d_by_loops(x, kernel, stride), rtol=1e-12, atol=1e-12)
    ours = conv3d_transpose(x, kernel, lowering=lowering)
    np.testing.assert_allclose(ours, transpose_by_loops(x, kernel), rtol=1e-12, atol=1e-12)


def value_and_gradients(fn, x, kernel, lowering):
    def both(x, kernel):
        out, pull = jax.vjp(lambda x, kernel: fn(x, kernel, lowering=lowering), x, kernel)
        return out, *pull(jnp.sin(jnp.arange(out.size, dtype=out.dtype)).reshape(out.shape))

    return jax.jit(both)(x, kernel)


@pytest.mark.parametrize("size", SIZES)
def test_lowerings_have_one_value_and_one_gradient(size):
    x, kernel = volume_and_kernel(*size)
    strided = lambda x, kernel, lowering: conv3d(x, kernel, stride=2, lowering=lowering)
    for fn in (conv3d, strided, conv3d_transpose):
        plain, folded = (value_and_gradients(fn, x, kernel, lowering) for lowering in ("plain", "folded"))
        for ours, theirs in zip(folded, plain, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=2e-5, atol=2e-5)


def test_transposed_is_the_adjoint_of_strided(x64):
    rng = np.random.default_rng(0)
    fine, coarse = rng.normal(size=(4, 6, 2, 3)), rng.normal(size=(2, 3, 1, 5))
    kernel = rng.normal(size=(3, 3, 3, 3, 5))
    down = jnp.vdot(conv3d(fine, kernel, stride=2), coarse)
    up = jnp.vdot(fine, conv3d_transpose(coarse, kernel.swapaxes(3, 4)))
    np.testing.assert_allclose(down, up, rtol=1e-12)


def test_a_central_tap_copies_and_a_strided_one_takes_every_other_cell():
    x, _ = volume_and_kernel(3, 4, 5, 2, 2)
    kernel = np.zeros((3, 3, 3, 2, 2), np.float32)
    kernel[1, 1, 1] = np.eye(2)
    np.testing.assert_array_equal(conv3d(x, kernel), x)
    np.testing.assert_array_equal(conv3d(x, kernel, stride=2), x[::2, ::2, ::2])
    np.testing.assert_array_equal(conv3d_transpose(x, kernel)[::2, ::2, ::2], x)


def test_faults_are_named():
    x, kernel = volume_and_kernel(2, 2, 2, 3, 2)
    with pytest.raises(ValueError, match="conv3d: axis in of `x` is 2, expected 3"):
        conv3d(x[..., :2], kernel)
    with pytest.raises(ValueError, match="conv3d: `lowering` is 'fast'"):
        conv3d(x, kernel, lowering="fast")
    with pytest.raises(ValueError, match="conv3d: `stride` is 3"):
        conv3d(x, kernel, stride=3)
    with pytest.raises(ValueError, match="conv3d_transpose: axis in"):
        conv3d_transpose(x[..., :2], kernel)
