import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from zestjax.nets import conv2d as conv2d_module
from zestjax.nets.conv2d import convolve2d, doubled_convolve2d
from zestjax.nets.layers import Conv, conv2d, init_conv2d


def image_and_kernel(batch, h, w, size, n_in, n_out, dtype: type = np.float32):
    rng = np.random.default_rng(h + 10 * w)
    return rng.normal(size=(batch, h, w, n_in)).astype(dtype), rng.normal(size=(size, size, n_in, n_out)).astype(dtype)


def conv2d_by_loops(x, kernel, stride):
    size = [x.shape[0], *(-(-n // stride) for n in x.shape[1:3])]
    out = np.zeros((*size, kernel.shape[-1]))
    for b, i, j in np.ndindex(*size):
        for s, t in np.ndindex(kernel.shape[:2]):
            row, col = stride * i + s - kernel.shape[0] // 2, stride * j + t - kernel.shape[1] // 2
            if 0 <= row < x.shape[1] and 0 <= col < x.shape[2]:
                out[b, i, j] += x[b, row, col] @ kernel[s, t]
    return out


@pytest.mark.parametrize("size", [1, 3, 5])
@pytest.mark.parametrize("stride", [1, 2])
def test_agrees_with_loops_in_float64(x64, size, stride):
    x, kernel = image_and_kernel(2, 5, 4, size, 2, 3, np.float64)
    bias = np.arange(3.0)
    ours = conv2d(Conv(jnp.asarray(kernel), jnp.asarray(bias)), x, stride=stride)
    np.testing.assert_allclose(ours, conv2d_by_loops(x, kernel, stride) + bias, rtol=1e-12, atol=1e-12)


def value_and_gradients(fn, *args):
    def both(*args):
        out, pull = jax.vjp(fn, *args)
        return out, *pull(jnp.sin(jnp.arange(out.size, dtype=out.dtype)).reshape(out.shape))

    return jax.jit(both)(*args)


def assert_same(ours, theirs):
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-5)


# Few channels take XLA's kernel gradient and many our own; odd and single sizes test the parities' edges.
@pytest.mark.parametrize("shape", [(2, 7, 4, 5, 3, 4), (1, 6, 5, 3, 32, 16), (2, 1, 4, 5, 32, 16)])
@pytest.mark.parametrize("stride", [1, 2])
def test_gradients_are_those_of_the_plain_form(shape, stride):
    x, kernel = image_and_kernel(*shape)
    reach = kernel.shape[0] // 2
    plain = lambda x, kernel: lax.conv_general_dilated(
        x, kernel, (stride,) * 2, [(reach, reach)] * 2, dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    ours = value_and_gradients(lambda x, kernel: convolve2d(x, kernel, stride), x, kernel)
    assert_same(ours, value_and_gradients(plain, x, kernel))


def test_doubling_then_convolving_is_what_it_says():
    x, kernel = image_and_kernel(2, 3, 4, 3, 3, 2)
    literally = lambda x, kernel: convolve2d(x.repeat(2, axis=1).repeat(2, axis=2), kernel, 1)
    assert_same(
        value_and_gradients(doubled_convolve2d, x, kernel),
        value_and_gradients(literally, jnp.asarray(x), kernel),
    )


def test_other_devices_get_xlas_own_convolution(monkeypatch):
    x, kernel = image_and_kernel(2, 3, 4, 3, 3, 2)
    ours = convolve2d(x, kernel, 2), doubled_convolve2d(x, kernel)
    monkeypatch.setattr(conv2d_module.jax, "default_backend", lambda: "gpu")
    assert_same(ours, (convolve2d(x, kernel, 2), doubled_convolve2d(x, kernel)))


def test_the_gradient_can_be_differentiated_again():
    x, kernel = image_and_kernel(1, 3, 4, 3, 2, 2)
    penalty = lambda x: jnp.sum(jax.grad(lambda x: jnp.sum(jnp.sin(convolve2d(x, kernel, 2))))(x) ** 2)
    assert jnp.all(jnp.isfinite(jax.grad(penalty)(x)))


def test_initial_variance_keeps_the_signal():
    conv = init_conv2d(jax.random.key(0), 3, 64, 48, bias=False)
    assert conv.bias is None
    np.testing.assert_allclose(jnp.std(conv.kernel), (2 / (9 * 64)) ** 0.5, rtol=0.05)


def test_faults_are_named():
    conv = Conv(jnp.zeros((3, 3, 4, 2)), None)
    with pytest.raises(ValueError, match="conv2d: axis in of `x` is 3, expected 4"):
        conv2d(conv, jnp.zeros((1, 2, 2, 3)))
    with pytest.raises(ValueError, match="conv2d: `stride` is 3"):
        conv2d(conv, jnp.zeros((1, 2, 2, 4)), stride=3)
