"""Seconds of the networks and of their 3-D convolutions, forward and with the gradient; one JSON line a case.

    python experiments/benchmarks/nets.py [--scale 0.5] [--repeats 7] [--only conv3d]

The two sides of a comparison are interleaved, the first two calls are discarded, and every result is waited for. Where
PyTorch is installed, 3-D convolutions are timed in it too.
"""

import argparse
import functools
import importlib.util
import json
import os
import statistics
import time

import jax
import jax.numpy as jnp

from zestjax.nets.conv3d import conv3d, conv3d_transpose
from zestjax.nets.cost_regulariser import cost_regulariser, init_cost_regulariser
from zestjax.nets.feature_pyramid import feature_pyramid, init_feature_pyramid
from zestjax.nets.unet2d import init_unet2d, unet2d

# Depth, height, width, channels in, channels out, stride (None: transposed), at paper scale.
LAYERS = [
    (128, 72, 136, 56, 8, 1),
    (128, 72, 136, 8, 16, 2),
    (64, 36, 68, 16, 16, 1),
    (32, 18, 34, 32, 32, 1),
    (64, 36, 68, 16, 8, None),
]


def with_gradient(fn):
    """The value's and both arguments' gradients of a function whose output is summed in squares."""
    return jax.grad(lambda *args: jnp.sum(jnp.square(fn(*args))), (0, 1))


def seconds(fns, args, repeats):
    """{name: (best, median)} of jitted functions of the same arguments, interleaved."""
    fns = {name: jax.jit(fn) for name, fn in fns.items()}
    times = {name: [] for name in fns}
    for _ in range(repeats + 2):
        for name, fn in fns.items():
            start = time.perf_counter()
            jax.block_until_ready(fn(*args))
            times[name].append(time.perf_counter() - start)
    return {name: (min(t[2:]), statistics.median(t[2:])) for name, t in times.items()}


def report(case, shape, results):
    """One line for each timed function."""
    for name, (best, median) in results.items():
        line = {"case": case, "shape": shape, "what": name, "best": round(best, 5), "median": round(median, 5)}
        print(json.dumps({**line, "load": round(os.getloadavg()[0], 1)}), flush=True)


def time_layers(scale, repeats, lowerings):
    """Every 3-D convolution of the U-Net in each lowering."""
    for *size, n_in, n_out, stride in LAYERS:
        size = [max(2, int(n * scale)) for n in size]
        x = jax.random.normal(jax.random.key(0), (*size, n_in))
        kernel = jax.random.normal(jax.random.key(1), (3, 3, 3, n_in, n_out))
        fns = {}
        for how in lowerings:
            options = {"lowering": how} if stride is None else {"lowering": how, "stride": stride}
            conv = functools.partial(conv3d_transpose if stride is None else conv3d, **options)
            fns |= {f"{how} forward": conv, f"{how} gradient": with_gradient(conv)}
        results = seconds(fns, (x, kernel), repeats)
        if importlib.util.find_spec("torch"):
            results |= torch_layer(size, n_in, n_out, stride, repeats)
        report(f"conv3d stride {stride}", [*size, n_in, n_out], results)


def torch_layer(size, n_in, n_out, stride, repeats):
    """The same convolution in PyTorch's default layout."""
    import torch  # pyright: ignore[reportMissingImports]

    x = torch.randn(1, n_in, *size, requires_grad=True)
    layer = torch.nn.Conv3d(n_in, n_out, 3, stride or 1, 1, bias=False)
    if stride is None:
        layer = torch.nn.ConvTranspose3d(n_in, n_out, 3, 2, 1, output_padding=1, bias=False)
    times = {"torch forward": [], "torch gradient": []}
    for _ in range(repeats + 2):
        start = time.perf_counter()
        with torch.no_grad():
            layer(x)
        times["torch forward"].append(time.perf_counter() - start)
        start = time.perf_counter()
        layer(x).square().sum().backward()
        times["torch gradient"].append(time.perf_counter() - start)
    return {name: (min(t[2:]), statistics.median(t[2:])) for name, t in times.items()}


def time_networks(scale, repeats):
    """The three networks at the sizes they are used at."""
    of = lambda *shape: [max(4, int(n * scale)) for n in shape]
    key = jax.random.key(0)
    cases = {
        "feature_pyramid": (feature_pyramid, init_feature_pyramid(key), (8, *of(288, 512), 3)),
        "cost_regulariser": (
            cost_regulariser,
            init_cost_regulariser(key, 32, widths=(8, 16, 32)),
            (*of(64, 72, 128), 32),
        ),
        "unet2d": (unet2d, init_unet2d(key, 64, (32, 48, 64), 32), (13, *of(72, 128), 64)),
    }
    for name, (fn, params, shape) in cases.items():
        x = jax.random.normal(key, shape)
        report(name, list(shape), seconds({"forward": fn, "gradient": with_gradient(fn)}, (params, x), repeats))


def main():
    """Parse the options and print the lines."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", type=float, default=0.5, help="of every spatial axis (default: half)")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--only", choices=("conv3d", "networks"))
    parser.add_argument("--plain", action="store_true", help="also XLA's own 3-D convolutions (minutes on a CPU)")
    options = parser.parse_args()
    if options.only != "conv3d":
        time_networks(options.scale, options.repeats)
    if options.only != "networks":
        time_layers(options.scale, options.repeats, ("folded", "plain") if options.plain else ("folded",))


if __name__ == "__main__":
    main()
