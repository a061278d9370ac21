"""2-D convolution of stride 1 or 2 whose gradient is fast on a CPU too.

XLA's forward is kept everywhere. On a CPU its gradients are replaced where they are slow: that of a strided
convolution's input by a convolution over the four parities of the pixels, that of a wide kernel by one matrix product
an image. On an accelerator everything is XLA's.

Vocabulary:
  parity: whether a row (column) of the padded image is even or odd; an image's four parities side by side are channels.
  columns: what each tap of the kernel reads, side by side as channels.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

IMAGES = ("NHWC", "HWIO", "NHWC")
# DOUBLED[s, p, i] is 1 where, on one axis, tap i at pixel 2 j + p of the doubled image reads pixel j + s - 1.
DOUBLED = np.zeros((3, 2, 3))
DOUBLED[0, 0, 0] = DOUBLED[1, 0, 1] = DOUBLED[1, 0, 2] = DOUBLED[1, 1, 0] = DOUBLED[1, 1, 1] = DOUBLED[2, 1, 2] = 1


def convolve2d(x: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    """x (B, H, W, in), kernel (size, size, in, out), size odd -> (B, ceil(H / stride), ceil(W / stride), out).

    Output pixel j is centred on input pixel `stride` j; zero outside. `stride` is 1 or 2.
    """
    return (_convolve if jax.default_backend() == "cpu" else _convolve_plain)(x, kernel, stride)


def doubled_convolve2d(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Convolution after doubling every pixel: x (B, H, W, in), kernel (3, 3, in, out) -> (B, 2 H, 2 W, out)."""
    return (_doubled if jax.default_backend() == "cpu" else _doubled_plain)(x, kernel)


def _convolve_plain(x, kernel, stride):
    reach = kernel.shape[0] // 2
    return lax.conv_general_dilated(x, kernel, (stride,) * 2, [(reach, reach)] * 2, dimension_numbers=IMAGES)


_convolve = jax.custom_vjp(_convolve_plain, nondiff_argnums=(2,))


def _convolve_bwd(stride, saved, d_out):
    x, kernel = saved
    size, _, n_in, n_out = kernel.shape
    form = _convolve_plain if stride == 1 else _convolve_parities
    (d_x,) = jax.vjp(lambda x: form(x, kernel, stride), x)[1](d_out)
    if n_in * stride >= 32 and n_out >= 16:  # wide: from here on the product is faster on a CPU
        return d_x, _kernel_gradient(x, d_out, size, stride)
    return d_x, jax.vjp(lambda kernel: _convolve_plain(x, kernel, stride), kernel)[1](d_out)[0]


_convolve.defvjp(lambda x, kernel, stride: (_convolve(x, kernel, stride), (x, kernel)), _convolve_bwd)


def _kernel_gradient(x, d_out, size, stride):
    """Columns of the image, transposed, times the output's gradient; one image's columns at a time stay in cache."""
    reach, n_in, n_out = size // 2, x.shape[-1], d_out.shape[-1]
    rows, cols = (stride * (n - 1) + 1 for n in d_out.shape[1:3])

    def image(total, inputs):
        x, d_out = inputs
        x = jnp.pad(x, [(reach, reach), (reach, reach), (0, 0)])
        taps = [x[i : i + rows : stride, j : j + cols : stride] for i in range(size) for j in range(size)]
        columns = jnp.concatenate(taps, axis=-1).reshape(-1, size * size * n_in)
        return total + columns.T @ d_out.reshape(-1, n_out), None

    total, _ = lax.scan(image, jnp.zeros((size * size * n_in, n_out), x.dtype), (x, d_out))
    return total.reshape(size, size, n_in, n_out)


def _convolve_parities(x, kernel, stride):
    """The strided convolution as one of stride 1 over the image's four parities; only its transpose is ever run."""
    del stride  # 2
    batch, h, w, n_in = x.shape
    size = kernel.shape[0]
    odd = size // 2 % 2  # a row of zeros in front aligns blocks of two with the kernel
    blocks_h, blocks_w = -(-h // 2) + odd, -(-w // 2) + odd
    x = jnp.pad(x, [(0, 0), (odd, 2 * blocks_h - h - odd), (odd, 2 * blocks_w - w - odd), (0, 0)])
    x = x.reshape(batch, blocks_h, 2, blocks_w, 2, n_in).transpose(0, 1, 3, 2, 4, 5)
    half = (size + 1) // 2
    kernel = jnp.pad(kernel, [(0, 1), (0, 1), (0, 0), (0, 0)]).reshape(half, 2, half, 2, n_in, -1)
    kernel = kernel.transpose(0, 2, 1, 3, 4, 5).reshape(half, half, 4 * n_in, -1)
    before = (size // 2 - odd) // 2
    padding = [(before, half - 1 - before - odd)] * 2
    x = x.reshape(batch, blocks_h, blocks_w, 4 * n_in)
    return lax.conv_general_dilated(x, kernel, (1, 1), padding, dimension_numbers=IMAGES)


def _doubled_plain(x, kernel):
    return _convolve_plain(jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2), kernel, 1)


_doubled = jax.custom_vjp(_doubled_plain)
_doubled.defvjp(
    lambda x, kernel: (_doubled_plain(x, kernel), (x, kernel)),
    lambda saved, d_out: jax.vjp(_doubled_parities, *saved)[1](d_out),
)


def _doubled_parities(x, kernel):
    """The same, at the image's own size: the four output parities as channels. Only its transpose is ever run."""
    batch, h, w, n_in = x.shape
    parity = jnp.asarray(DOUBLED, kernel.dtype)
    kernel = jnp.einsum("sai,tbj,ijmn->stmabn", parity, parity, kernel).reshape(3, 3, n_in, -1)
    out = _convolve(x, kernel, 1).reshape(batch, h, w, 2, 2, -1)
    return out.transpose(0, 1, 3, 2, 4, 5).reshape(batch, 2 * h, 2 * w, -1)
