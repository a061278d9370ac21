"""3-D convolutions of kernel size 3, in the forms that are fast where XLA's own are not.

XLA's 3-D convolution, and above all its gradient, is tens of times slower on a CPU than the same sums written as 2-D
convolutions or matrix products; on a GPU it is cuDNN's and wins. Hence a `lowering`: same numbers, different program.

Vocabulary:
  tap: one of the 27 offsets of the kernel; depth tap: one of its three planes.
  parity: whether an output index of a transposed convolution is even or odd, on each axis.
"""

import jax
import jax.numpy as jnp
from jax import lax

from zestjax.checks import check_option, check_shapes

VOLUMES = ("NDHWC", "DHWIO", "NDHWC")
IMAGES = ("NHWC", "HWIO", "NHWC")
TAPS = [(i, j, k) for i in range(3) for j in range(3) for k in range(3)]
LOWERINGS = ("auto", "plain", "taps", "col2im")
TRANSPOSE_LOWERINGS = ("auto", "plain", "phases")


def conv3d(x, kernel, *, stride=1, lowering="auto"):
    """Zero-padded convolution x (D, H, W, in) -> (ceil(D / stride), ceil(H / stride), ceil(W / stride), out).

    Args:
      x: (D, H, W, in).
      kernel: (3, 3, 3, in, out).
      stride: 1 or 2, on all axes; output cell j sits on input cell `stride` j.
      lowering: "plain" (XLA's), "taps" (three 2-D convolutions, one for each depth tap), "col2im" (a product to 27 out
        columns a plane, then shifted adds: for many channels in and few out; stride 1), or "auto": "plain" on an
        accelerator, on a CPU the faster of the others for these channels.

    Raises:
      ValueError: if shapes do not fit, or the lowering is unknown or cannot have this stride.
    """
    sizes = check_shapes("conv3d", kernel=(kernel, "3 3 3 in out"), x=(x, "D H W in"))
    check_option("conv3d", lowering=(lowering, LOWERINGS), stride=(stride, (1, 2)))
    if lowering == "auto":
        few_out = stride == 1 and sizes["out"] <= 8 and sizes["in"] >= 24
        lowering = "plain" if jax.default_backend() != "cpu" else "col2im" if few_out else "taps"
    if lowering == "col2im":
        check_option('conv3d with lowering="col2im"', stride=(stride, (1,)))
        return _conv_col2im(x, kernel)
    return (_conv_plain if lowering == "plain" else _conv_taps)(x, kernel, stride)


def conv3d_transpose(x, kernel, *, lowering="auto"):
    """Transposed convolution of stride 2: x (D, H, W, in) -> (2 D, 2 H, 2 W, out).

    On each axis, input cell j adds x[j] kernel[i] to output cell 2 j + i - 1: published kernels need their axes
    permuted, not flipped.

    Args:
      x: (D, H, W, in).
      kernel: (3, 3, 3, in, out).
      lowering: "plain" (XLA's, zero-stuffed input), "phases" (each of the eight output parities from its own
        taps, no zeros), or "auto": "plain" on an accelerator, "phases" on a CPU.

    Raises:
      ValueError: if shapes do not fit, or the lowering is unknown.
    """
    check_shapes("conv3d_transpose", kernel=(kernel, "3 3 3 in out"), x=(x, "D H W in"))
    check_option("conv3d_transpose", lowering=(lowering, TRANSPOSE_LOWERINGS))
    if lowering == "auto":
        lowering = "phases" if jax.default_backend() == "cpu" else "plain"
    return (_transpose_plain if lowering == "plain" else _transpose_phases)(x, kernel)


def _conv_plain(x, kernel, stride):
    return lax.conv_general_dilated(x[None], kernel, (stride,) * 3, [(1, 1)] * 3, dimension_numbers=VOLUMES)[0]


def _conv_taps(x, kernel, stride):
    last = (x.shape[0] - 1) // stride * stride
    x = jnp.pad(x, [(1, 1), (0, 0), (0, 0), (0, 0)])
    planes = [lax.slice_in_dim(x, i, i + last + 1, stride) for i in range(3)]
    convolve = lambda plane, tap: lax.conv_general_dilated(
        plane, tap, (stride, stride), [(1, 1)] * 2, dimension_numbers=IMAGES
    )
    return sum(convolve(plane, tap) for plane, tap in zip(planes[1:], kernel[1:], strict=True)) + convolve(
        planes[0], kernel[0]
    )


@jax.custom_vjp
def _conv_col2im(x, kernel):
    depth, h, w, n_in = x.shape
    n_out = kernel.shape[-1]
    columns_kernel = kernel.transpose(3, 0, 1, 2, 4).reshape(n_in, 27 * n_out)

    def plane(ring, x_plane):
        """Output planes get their last share from the input plane after them; `ring` holds the two unfinished ones."""
        columns = (x_plane.reshape(-1, n_in) @ columns_kernel).reshape(h, w, 3, 3, 3, n_out)
        columns = jnp.pad(columns, [(1, 1), (1, 1)] + [(0, 0)] * 4)
        shares = [sum(columns[j : j + h, k : k + w, i, j, k] for j in range(3) for k in range(3)) for i in range(3)]
        return (ring[1] + shares[1], shares[0]), ring[0] + shares[2]

    zero = jnp.zeros((h, w, n_out), x.dtype)
    ring, out = lax.scan(plane, (zero, zero), x)
    return jnp.concatenate([out[1:], ring[0][None]])


def _conv_col2im_bwd(saved, d_out):
    """Both gradients of a plane from one gather of the output's: every tap's reading of it, side by side."""
    x, kernel = saved
    depth, h, w, n_in = x.shape
    n_out = kernel.shape[-1]
    kernel_columns = kernel.transpose(0, 1, 2, 4, 3).reshape(27 * n_out, n_in)
    d_out = jnp.pad(d_out, [(1, 1), (1, 1), (1, 1), (0, 0)])

    def plane(d_kernel, inputs):
        x_plane, z = inputs
        near = lax.dynamic_slice_in_dim(d_out, z, 3)
        columns = jnp.concatenate([near[2 - i, 2 - j : 2 - j + h, 2 - k : 2 - k + w] for i, j, k in TAPS], axis=-1)
        columns = columns.reshape(-1, 27 * n_out)
        return d_kernel + x_plane.reshape(-1, n_in).T @ columns, (columns @ kernel_columns).reshape(h, w, n_in)

    d_kernel, d_x = lax.scan(plane, jnp.zeros((n_in, 27 * n_out), x.dtype), (x, jnp.arange(depth)))
    return d_x, d_kernel.reshape(n_in, 3, 3, 3, n_out).transpose(1, 2, 3, 0, 4)


_conv_col2im.defvjp(lambda x, kernel: (_conv_col2im(x, kernel), (x, kernel)), _conv_col2im_bwd)


def _transpose_plain(x, kernel):
    flipped = kernel[::-1, ::-1, ::-1]
    return lax.conv_general_dilated(
        x[None], flipped, (1,) * 3, [(1, 2)] * 3, lhs_dilation=(2,) * 3, dimension_numbers=VOLUMES
    )[0]


def _transpose_phases(x, kernel):
    """On an axis, output 2 j takes x[j] kernel[1], output 2 j + 1 takes x[j] kernel[2] + x[j + 1] kernel[0]."""
    depth, h, w, _ = x.shape
    x = jnp.pad(x, [(0, 1), (0, 1), (0, 1), (0, 0)])
    reads = (((0, 1),), ((0, 2), (1, 0)))  # by parity: (shift of the input, tap)
    phases = [
        sum(
            x[s : s + depth, t : t + h, u : u + w] @ kernel[i, j, k]
            for s, i in reads[a]
            for t, j in reads[b]
            for u, k in reads[c]
        )
        for a in (0, 1)
        for b in (0, 1)
        for c in (0, 1)
    ]
    out = jnp.stack(phases).reshape(2, 2, 2, depth, h, w, -1)
    return out.transpose(3, 0, 4, 1, 5, 2, 6).reshape(2 * depth, 2 * h, 2 * w, -1)
