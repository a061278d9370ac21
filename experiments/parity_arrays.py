"""MVSNeRF's stages as this library computes them, in the layout of the authors' recorded arrays; for `check_parity`.

Sizes are the file's own: views, planes and pixels of its arrays' shapes, paddings and the depth of the full volume of
their names. All views but the last are sources, the first of them the reference; the last is the target. A stage is
computed from the recorded arrays that precede it; the volumes and the rendered pixels are, from the images.

record   arrays by name, channels first
V D      source views, planes
mode     of the norms: `train`, by the images at hand, as published; `eval`, by the stored statistics
"""

import functools
import re

import jax
import jax.numpy as jnp

from zestjax.base.numerics import matvec
from zestjax.cameras import Camera, scaled
from zestjax.depth import expected_depth
from zestjax.nets.conv3d import conv3d, conv3d_transpose
from zestjax.nets.cost_regulariser import cost_regulariser
from zestjax.nets.feature_pyramid import STRIDES, feature_pyramid, imagenet_normalised
from zestjax.nets.layers import block2d, norm_act
from zestjax.nets.positional import positional_encoding
from zestjax.planesweep import carry, homographies, plane_depths, sweep_grid, warp
from zestjax.rays import rays_from_pixels
from zestjax.rendering import composite, weights_from_density
from zestjax.systems import mvsnerf
from zestjax.systems.fields import Marched, Seen

CELLS_KEPT = (8, 4, 4)  # of the full volume one in so many along each axis, where shapes do not say otherwise
PLANES_KEPT = 5  # of a warped view one in so many, likewise
UNDECIDED = 1e-4  # of half an image: a point so near its border may be on either side of it after rounding


@jax.jit
def features_of(params, images):
    """Activations of the first block and before the closing convolution, and the features; (V, C, h, w) each."""
    x, stages = imagenet_normalised(images), []
    for block, stride in zip(params.blocks, STRIDES, strict=True):
        x = block2d(block, x, stride=stride, legacy_abs=True)
        stages.append(x)
    out = (stages[0], stages[-1], feature_pyramid(params, images, legacy_abs=True))
    return tuple(jnp.moveaxis(y, -1, 1) for y in out)


@functools.partial(jax.jit, static_argnames=("planes", "padding"))
def volumes_of(params, sources, *, planes, padding):
    """The cost volume and the encoding volume, (C, D, h, w) each."""
    cost = mvsnerf.cost(params, sources, planes=planes, padding=padding)
    built = cost_regulariser(params.regulariser, cost, legacy_abs=True)
    return jnp.moveaxis(cost, -1, 0), jnp.moveaxis(built, -1, 0)


@jax.jit
def _regularised(net, cost):
    """By its published number: each level of the 3-D network on the way down, and the first up before its skip."""
    act = lambda block, x: norm_act(block.norm, x, legacy_abs=True)
    x = act(net.stem, conv3d(jnp.moveaxis(cost, 0, -1), net.stem.conv.kernel))
    found = [x]
    for halve, follow in net.downs:
        x = act(follow, conv3d(act(halve, conv3d(x, halve.conv.kernel, stride=2)), follow.conv.kernel))
        found.append(x)
    found.append(act(net.ups[-1], conv3d_transpose(x, net.ups[-1].conv.kernel)))
    return {number: jnp.moveaxis(y, -1, 0) for number, y in zip((0, 2, 4, 6, 7), found, strict=True)}


@functools.partial(jax.jit, static_argnames=("cells", "padding"))
def _swept(cameras, depths, *, cells, padding):
    """Of every view: its normalised pixels (D, h, w, 2) on every plane, which are in front, and homographies."""
    warps = jnp.moveaxis(homographies(jax.tree.map(lambda x: x[0], cameras), cameras, depths), 0, 1)
    u, v, _, front = carry(warps, sweep_grid(*cells, padding=padding))
    rows, columns = cells
    return jnp.stack([u / ((columns - 1) / 2) - 1, v / ((rows - 1) / 2) - 1], -1), front, warps


@functools.partial(jax.jit, static_argnames=("cells", "padding"))
def _warped(features, warps, *, cells, padding):
    """(C, planes, h, w) of a view's features (C, h, w)."""
    image, grid = jnp.moveaxis(features, 0, -1), sweep_grid(*cells, padding=padding)
    return jnp.moveaxis(jax.vmap(lambda warp_of: warp(image, warp_of, grid).values)(warps), -1, 0)


@functools.partial(jax.jit, static_argnames="padding")
def _rendered(params, built, sources, camera, pixels, depths, *, padding):
    """Colours (R, 3) and depths (R,) of pixels of a camera: `systems.system.render` with samples at given depths."""
    rays, reference = rays_from_pixels(camera, pixels), mvsnerf.reference(sources)
    points = rays.origins[:, None] + depths[..., None] * rays.directions[:, None]
    unit = rays.directions / jnp.linalg.norm(rays.directions, axis=-1, keepdims=True)
    turned = matvec(reference.camera_from_world[:3, :3], unit)
    marched = Marched(depths, points, points, points, jnp.ones_like(depths), turned)  # nothing asks for its coords
    seen = Seen(jnp.moveaxis(built, 0, -1), sources)
    found = mvsnerf.MvsNerf(padding=padding)(params, seen, marched, None)
    weights = weights_from_density(found.density, marched.lengths)
    return composite(weights, found.colour).values, expected_depth(weights, depths, background=0.0)


def paddings_of(record):
    """Those that the names state, ascending."""
    return sorted({int(n) for name in record for n in re.findall(r"_pad(\d+)", name)}) or [0]


def main_padding(record):
    """The padding of arrays whose names state none: the greatest for which there is a cost volume, or at all."""
    paddings = paddings_of(record)
    return max([p for p in paddings if f"cost_pad{p}_train" in record] or paddings)


class Golden:
    """A record and weights by mode, and what was computed of them.

    Called with a name: (this library's array, mask of what counts or None), by the function of `families` whose
    pattern the name matches.
    """

    def __init__(self, record, weights, families):
        self.record, self.weights, self.families, self.known = record, weights, families, {}
        cameras = Camera(record["intrinsics"], record["w2cs"])
        sources, (near, far) = jax.tree.map(lambda x: x[:-1], cameras), record["near_far"]
        self.images, self.cameras = jnp.moveaxis(record["imgs01"], 1, -1), cameras
        self.target = jax.tree.map(lambda x: x[-1], cameras)
        self.sources = mvsnerf.Sources(self.images[:-1], sources, near, far)
        self.quarter = scaled(cameras, 0.25, 0.25)
        self.cells = tuple(n // 4 for n in self.images.shape[1:3])
        self.padding = main_padding(record)

    def __call__(self, name):
        for pattern, compute in self.families.items():
            if found := re.fullmatch(pattern, name):
                said = [int(x) if x.isdigit() else x for x in found.groups()]
                out = self.kept(name, lambda compute=compute, said=said: compute(self, *said))
                return out if isinstance(out, tuple) else (out, None)
        raise KeyError(name)

    def kept(self, key, compute):
        """compute(), the first time that the key is asked for."""
        if key not in self.known:
            self.known[key] = compute()
        return self.known[key]

    def stored(self, name):
        """The record's array, or this library's where it has none."""
        return self.record[name] if name in self.record else self(name)[0]

    @property
    def planes(self):
        """D, by the first array that says it."""
        for pattern, axis in (("depth_values", -1), (r"(cost|vol)_pad\d+_\w+", 1), (r"grid\d+_pad\d+", 0)):
            for name, array in self.record.items():
                if re.fullmatch(pattern, name):
                    return array.shape[axis]
        raise ValueError("no array says how many planes there are")

    def depths(self, count):
        """(count,) from near to far."""
        return plane_depths(self.sources.near, self.sources.far, count)

    def features(self, mode):
        """See `features_of`."""
        params = getattr(self.weights, mode).features
        return self.kept(("features", mode), lambda: features_of(params, self.sources.images))

    def volumes(self, padding, mode, planes=None):
        """See `volumes_of`."""
        params, planes = getattr(self.weights, mode), planes or self.planes
        key = ("volumes", padding, mode, planes)
        return self.kept(key, lambda: volumes_of(params, self.sources, planes=planes, padding=padding))

    def full(self, planes, mode):
        """A volume of so many planes, and the strides of the cells that the record keeps of it."""
        built, name = self.volumes(self.padding, mode, planes)[1], f"vol{planes}_{mode}_strided"
        if name not in self.record:
            return built, CELLS_KEPT
        left = self.record[name].shape[1:]
        return built, tuple(_stride(*x) for x in zip(built.shape[1:], left, CELLS_KEPT, strict=True))

    def swept(self, padding):
        """See `_swept`."""
        depths = self.depths(self.planes)
        compute = lambda: _swept(self.quarter, depths, cells=self.cells, padding=padding)
        return self.kept(("swept", padding), compute)

    def regularised(self):
        """See `_regularised`."""
        net, name = self.weights.train.regulariser, f"cost_pad{self.padding}_train"
        return self.kept("regularised", lambda: _regularised(net, self.stored(name)))

    def rays(self):
        """The target's pixels and `Rays` through them."""
        pixels = jnp.stack([self.record["ray_px"], self.record["ray_py"]], -1)
        return pixels, rays_from_pixels(self.target, pixels)

    def rendered(self):
        """Colours and depths, of the images; see `_rendered`."""
        built, depths = self.volumes(self.padding, "train")[1], self.stored("z_jit")
        compute = lambda: _rendered(
            self.weights.train, built, self.sources, self.target, self.rays()[0], depths, padding=self.padding
        )
        return self.kept("rendered", compute)


def _stride(size, left, usual):
    """The stride that leaves so many of an axis's entries."""
    for stride in (usual, *range(1, size + 1)):
        if -(-size // stride) == left:
            return stride
    raise ValueError(f"no stride leaves {left} of {size}")


def projections(golden):
    """(V + 1, 3, 4) A | b: a reference pixel u at depth d is seen at A u + b / d."""
    reference = jax.tree.map(lambda x: x[0], golden.quarter)
    far, near = homographies(reference, golden.quarter, jnp.array([jnp.inf, 1]))
    return jnp.concatenate([far, (near - far)[..., 2:]], -1)


def first_block(golden, mode):
    """Of the views that the record keeps."""
    stored = golden.record.get(f"feat_conv0_0_{mode}")
    return golden.features(mode)[0][: 1 if stored is None or stored.ndim < 4 else len(stored)]


def normalised_pixels(golden, source, padding):
    """(D, h, w, 2) of a source on every plane; of what is not in front of it nothing counts."""
    places, front, _ = (x[source] for x in golden.swept(padding))
    return places, jnp.broadcast_to(front[..., None], places.shape)


def inside_masks(golden, padding):
    """(V, D, h, w) 1 strictly inside a source, and all over the reference; where rounding decides, nothing counts."""
    places, front, _ = (x[: len(golden.sources.images)] for x in golden.swept(padding))
    most = jnp.max(jnp.abs(places), -1)
    itself = (jnp.arange(len(most)) == 0).reshape(-1, 1, 1, 1)
    return ((most < 1) | itself).astype(places.dtype), front & (jnp.abs(most - 1) > UNDECIDED) | itself


def warped_features(golden, source, padding, mode):
    """(C, planes, h, w); only inside counts: over the pixel outside theirs fades to 0, ours is 0."""
    name = f"warp{source}_pad{padding}_{mode}"
    left = golden.record[name].shape[1] if name in golden.record else -(-golden.planes // PLANES_KEPT)
    every = _stride(golden.planes, left, PLANES_KEPT)
    places, front, warps = (x[source, ::every] for x in golden.swept(padding))
    values = _warped(golden.stored(f"feats_{mode}")[source], warps, cells=golden.cells, padding=padding)
    return values, jnp.broadcast_to(front & (jnp.max(jnp.abs(places), -1) < 1), values.shape)


def kept_cells(golden, planes, mode):
    built, steps = golden.full(planes, mode)
    return built[:, :: steps[0], :: steps[1], :: steps[2]]


def statistics(golden, planes):
    x, _ = golden.full(planes, "train")
    return jnp.stack([jnp.mean(x), jnp.std(x, ddof=1), jnp.min(x), jnp.max(x)])


def jittered_depths(golden):
    """(R, S) in strata that end half way between the regular depths."""
    regular = golden.stored("z_lin")
    middles = (regular[1:] + regular[:-1]) / 2
    low, high = jnp.concatenate([regular[:1], middles]), jnp.concatenate([middles, regular[-1:]])
    return low[None] + (high - low)[None] * golden.record["u_jitter"]


def ray_points(golden):
    rays = golden.rays()[1]
    return rays.origins[:, None] + golden.stored("z_jit")[..., None] * rays.directions[:, None]


def ray_features(golden, padding):
    built = jnp.moveaxis(golden.stored(f"vol_pad{padding}_train"), 0, -1)
    return mvsnerf.look_up(built, golden.stored(f"rays_ndc_pad{padding}"))


def view_colours(golden):
    points = golden.stored("rays_pts")
    return mvsnerf.view_colours(golden.sources, points.reshape(-1, 3)).reshape(*points.shape[:2], -1)


def encoded_points(golden):
    """Of the rays that the record keeps."""
    stored = golden.record.get("pe_xyz")
    coords = golden.stored(f"rays_ndc_pad{golden.padding}")[: 2 if stored is None else len(stored)]
    return positional_encoding(coords, levels=mvsnerf.LEVELS, order="mvsnerf")


def view_directions(golden):
    """(R, 3) unit, in the reference's axes."""
    directions = golden.rays()[1].directions
    unit = directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)
    return matvec(golden.cameras.camera_from_world[0, :3, :3][None], unit)


def field_outputs(golden):
    """(R, S, 4) colour and density."""
    coords, features = (golden.stored(f"{x}_pad{golden.padding}") for x in ("rays_ndc", "ray_feats"))
    rays, samples = coords.shape[:2]
    known = jnp.concatenate([features, golden.stored("ray_colors")], -1).reshape(rays * samples, -1)
    direction = jnp.repeat(golden.stored("view_dir"), samples, axis=0)
    found = mvsnerf.field(golden.weights.train.field, coords.reshape(-1, 3), known, direction)
    return jnp.concatenate([found.colour, found.density[:, None]], -1).reshape(rays, samples, 4)


def absorbed(golden, fn):
    """(R, S) a function of densities and lengths; an interval's length is not part of its opacity."""
    density = golden.stored("raw_rgbsigma")[..., 3]
    return fn(density, jnp.ones(density.shape[1:], density.dtype))
