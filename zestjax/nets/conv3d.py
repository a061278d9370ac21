"""3-D convolutions of kernel size 3, in a form that is fast where XLA's own is not.

XLA's 3-D convolution, and above all its gradient, is tens of times slower on a CPU than the same sums as one 2-D
convolution with the kernel's depth folded into the channels; on a GPU XLA's is cuDNN's and wins. Hence a `lowering`:
same numbers, different program.

Vocabulary:
  tap: one of the 27 offsets of the kernel.
  fine, coarse: the larger and the smaller volume of a convolution of stride 2; of stride 1: its input and its output.
  columns: what each tap reads of the fine volume, side by side as channels.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from zestjax.base.checks import check_option, check_shapes

VOLUMES = ("NDHWC", "DHWIO", "NDHWC")
IMAGES = ("NHWC", "HWIO", "NHWC")
LOWERINGS = ("auto", "plain", "folded")  # see `conv3d`: XLA's 3-D convolutions are slow on a CPU
# PARITY[s, p, i] is 1 where tap i takes input j + s to output 2 j + p of a transposed convolution, on one axis.
PARITY = np.zeros((2, 2, 3))
PARITY[0, 0, 1] = PARITY[0, 1, 2] = PARITY[1, 1, 0] = 1


def conv3d(x: jax.Array, kernel: jax.Array, *, stride: int = 1, lowering: str = "auto") -> jax.Array:
    """Zero-padded convolution x (D, H, W, in) -> (ceil(D / stride), ceil(H / stride), ceil(W / stride), out).

    Args:
      x: (D, H, W, in).
      kernel: (3, 3, 3, in, out).
      stride: 1 or 2, on all axes; output cell j sits on input cell `stride` j.
      lowering: "plain" (XLA's), "folded" (2-D convolutions, own gradients), or "auto": "folded" on a CPU, else "plain".

    Raises:
      ValueError: if shapes do not fit, or an option is unknown.
    """
    check_shapes("conv3d", kernel=(kernel, "3 3 3 in out"), x=(x, "D H W in"))
    check_option("conv3d", stride=(stride, (1, 2)))
    if _lowering("conv3d", lowering) == "folded":
        return _conv(x, kernel, stride)
    return lax.conv_general_dilated(x[None], kernel, (stride,) * 3, [(1, 1)] * 3, dimension_numbers=VOLUMES)[0]


def conv3d_transpose(x: jax.Array, kernel: jax.Array, *, lowering: str = "auto") -> jax.Array:
    """Transposed convolution of stride 2: x (D, H, W, in) -> (2 D, 2 H, 2 W, out).

    On each axis, input cell j adds x[j] kernel[i] to output cell 2 j + i - 1: published kernels need their axes
    permuted, not flipped.

    Args:
      x: (D, H, W, in).
      kernel: (3, 3, 3, in, out).
      lowering: "plain" (XLA's, zero-stuffed input), "folded" (a 2-D convolution to the eight output parities, own
        gradients), or "auto": "folded" on a CPU, else "plain".

    Raises:
      ValueError: if shapes do not fit, or the lowering is unknown.
    """
    check_shapes("conv3d_transpose", kernel=(kernel, "3 3 3 in out"), x=(x, "D H W in"))
    if _lowering("conv3d_transpose", lowering) == "folded":
        return _conv_transpose(x, kernel)
    x, kernel, padding = x[None], kernel[::-1, ::-1, ::-1], [(1, 2)] * 3
    return lax.conv_general_dilated(x, kernel, (1,) * 3, padding, (2,) * 3, dimension_numbers=VOLUMES)[0]


def _lowering(where, lowering):
    check_option(where, lowering=(lowering, LOWERINGS))
    return ("folded" if jax.default_backend() == "cpu" else "plain") if lowering == "auto" else lowering


def _reverse(kernel):
    """The kernel that takes an output's gradient back to the input of a convolution of stride 1."""
    return kernel[::-1, ::-1, ::-1].swapaxes(3, 4)


def _gather(fine, kernel, stride):
    """Coarse volume of a fine one: one 2-D convolution, the kernel's depth among its channels in, or out if fewer."""
    n_in, n_out = kernel.shape[3:]
    convolve = lambda x, kernel: lax.conv_general_dilated(
        x, kernel, (stride, stride), [(1, 1)] * 2, dimension_numbers=IMAGES
    )
    if n_in <= n_out or stride == 2:
        kernel = kernel.transpose(1, 2, 0, 3, 4).reshape(3, 3, 3 * n_in, n_out)
        return convolve(jnp.concatenate(_depth_taps(fine, stride), axis=-1), kernel)
    shares = convolve(fine, kernel.transpose(1, 2, 3, 0, 4).reshape(3, 3, n_in, 3 * n_out))
    first, second, third = (shares[..., i * n_out : (i + 1) * n_out] for i in range(3))
    return _depth_taps(first, 1)[0] + second + _depth_taps(third, 1)[2]


def _depth_taps(fine, stride):
    """What each of the kernel's planes reads of a volume: three of (ceil(D / stride), H, W, C), zero outside."""
    planes = (fine.shape[0] - 1) // stride * stride + 1
    fine = jnp.pad(fine, [(1, 1), (0, 0), (0, 0), (0, 0)])
    return [lax.slice_in_dim(fine, i, i + planes, stride) for i in range(3)]


def _spread(coarse, kernel):
    """Fine volume of a coarse one, stride 2: all eight output parities from one 2-D convolution, then interleaved."""
    depth, h, w, n_in = coarse.shape
    parity = jnp.asarray(PARITY, kernel.dtype)
    kernel = jnp.einsum("sai,tbj,uck,ijkmn->tusmabcn", parity, parity, parity, kernel)
    following = jnp.pad(coarse[1:], [(0, 1), (0, 0), (0, 0), (0, 0)])
    fine = lax.conv_general_dilated(
        jnp.concatenate([coarse, following], axis=-1),
        kernel.reshape(2, 2, 2 * n_in, -1),
        (1, 1),
        [(0, 1)] * 2,
        dimension_numbers=IMAGES,
    )
    fine = fine.reshape(depth, h, w, 2, 2, 2, -1).transpose(0, 3, 1, 4, 2, 5, 6)
    return fine.reshape(2 * depth, 2 * h, 2 * w, -1)


def _kernel_gradient(fine, coarse, stride):
    """The coarse volume, transposed, times columns of the fine one, plane by plane: (3, 3, 3, n_fine, n_coarse)."""
    n_fine, n_coarse = fine.shape[-1], coarse.shape[-1]
    if stride == 1 and n_coarse < n_fine:  # fewer columns
        return _reverse(_kernel_gradient(coarse, fine, 1))
    h, w = (stride * (n - 1) + 1 for n in coarse.shape[1:3])
    near = jnp.pad(jnp.concatenate(_depth_taps(fine, stride), axis=-1), [(0, 0), (1, 1), (1, 1), (0, 0)])

    def plane(total, inputs):
        near, coarse = inputs
        taps = [near[j : j + h : stride, k : k + w : stride] for j in range(3) for k in range(3)]
        columns = jnp.concatenate(taps, axis=-1).reshape(-1, 27 * n_fine)
        return total + coarse.reshape(-1, n_coarse).T @ columns, None

    total, _ = lax.scan(plane, jnp.zeros((n_coarse, 27 * n_fine), fine.dtype), (near, coarse))
    return total.reshape(n_coarse, 3, 3, 3, n_fine).transpose(3, 1, 2, 4, 0)


def _conv_bwd(stride, saved, d_out):
    x, kernel = saved
    if stride == 1:
        d_x = _gather(d_out, _reverse(kernel), 1)
    else:
        d_x = _spread(d_out, kernel.swapaxes(3, 4))[: x.shape[0], : x.shape[1], : x.shape[2]]
    return d_x, _kernel_gradient(x, d_out, stride)


_conv = jax.custom_vjp(_gather, nondiff_argnums=(2,))
_conv.defvjp(lambda x, kernel, stride: (_gather(x, kernel, stride), (x, kernel)), _conv_bwd)


def _conv_transpose_bwd(saved, d_out):
    x, kernel = saved
    return _gather(d_out, kernel.swapaxes(3, 4), 2), _kernel_gradient(d_out, x, 2).swapaxes(3, 4)


_conv_transpose = jax.custom_vjp(_spread)
_conv_transpose.defvjp(lambda x, kernel: (_spread(x, kernel), (x, kernel)), _conv_transpose_bwd)
