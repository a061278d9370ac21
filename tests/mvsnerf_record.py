"""A record of MVSNeRF's stages at sizes of its own: geometry, look-ups and compositing by numpy in float64.

Its networks are the library's. What `check_parity` reads off names and shapes is stated here in numbers.
"""

import jax
import jax.numpy as jnp
import numpy as np
from oracles import of_experiments
from scipy.ndimage import map_coordinates

from zestjax.cameras import Camera
from zestjax.systems import mvsnerf

parity_arrays = of_experiments("parity_arrays")

HEIGHT, WIDTH, VIEWS, PLANES, PADDING, FULL, RAYS, SAMPLES, NEAR, FAR = 32, 48, 3, 12, 8, 16, 5, 7, 1.5, 5.0
ROWS, COLUMNS = HEIGHT // 4, WIDTH // 4
LEFT_OUT = {"feat_conv0_0_train", "feat_conv2_train", "creg_conv0", "creg_conv2", "creg_conv4", "creg_conv6",
            "creg_conv7", "vol_pad8_eval", "vol16_stats", "vol_pad0_train", "ray_feats_pad0"}  # fmt: skip
"""What a whole record has beside what `made_record` makes."""


def made_params(like, seed=0):
    """Parameters of the published shapes, drawn by numpy; scales and variances above 0."""
    rng = np.random.default_rng(seed)

    def draw(path, x):
        positive = any(word in jax.tree_util.keystr(path) for word in ("scale", "variance"))
        size = np.sqrt(max(np.prod(x.shape[:-1]), 1)) if len(x.shape) > 1 else 8
        return jnp.asarray(rng.uniform(0.5, 1.5, x.shape) if positive else rng.normal(size=x.shape) / size, x.dtype)

    return jax.tree_util.tree_map_with_path(draw, like)


def seen(intrinsics, pose, points):
    """Pixels (..., 2) and depths of world points."""
    there = points @ pose[:3, :3].T + pose[:3, 3]
    image = there @ intrinsics.T
    return image[..., :2] / image[..., 2:], there[..., 2]


def read(image, u, v, mode):
    """(..., C) of (H, W, C) between its pixels."""
    return np.stack([map_coordinates(x, [v, u], order=1, mode=mode) for x in np.moveaxis(image, -1, 0)], -1)


def cameras(rng):
    """Intrinsics and poses of the sources and the target, float64 of float32 numbers."""
    k = np.tile([[50, 0, WIDTH / 2], [0, 52, HEIGHT / 2], [0, 0, 1]], (VIEWS + 1, 1, 1))
    poses = np.tile(np.eye(4), (VIEWS + 1, 1, 1))
    for i, angle in enumerate((0.1, 0.02, 0.12, 0.07)):
        poses[i, :3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    poses[:, :3, 3] = rng.normal(size=(VIEWS + 1, 3)) / 8
    return k.astype(np.float32).astype(np.float64), poses.astype(np.float32).astype(np.float64)


def geometry(k, poses, padding):
    """Of each source but the reference: normalised pixels (D, h, w, 2) on every plane, by points in space."""
    quarter = k * np.array([[0.25], [0.25], [1]])
    v, u = np.mgrid[-padding : ROWS + padding, -padding : COLUMNS + padding].astype(np.float64)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(quarter[0]).T
    points = np.linspace(NEAR, FAR, PLANES)[:, None, None, None] * rays
    world = (points - poses[0, :3, 3]) @ poses[0, :3, :3]
    places = [seen(quarter[i], poses[i], world)[0] for i in range(1, VIEWS)]
    return [place / [(COLUMNS - 1) / 2, (ROWS - 1) / 2] - 1 for place in places]


def swept(k, poses):
    """Arrays of the plane sweep by name, without its features."""
    out = {}
    for padding in (0, PADDING):
        grids = geometry(k, poses, padding)
        out |= {f"grid{i + 1}_pad{padding}": grid for i, grid in enumerate(grids)}
        inside = [np.abs(grid).max(-1) < 1 for grid in grids]
        out[f"inmask_pad{padding}"] = np.stack([np.ones_like(inside[0]), *inside])
    quarter = k * np.array([[0.25], [0.25], [1]])
    relative = poses @ np.linalg.inv(poses[0])
    turn = quarter @ relative[:, :3, :3] @ np.linalg.inv(quarter[0])
    out["proj_mats"] = np.concatenate([turn, quarter @ relative[:, :3, 3:]], -1)
    return out


def sampled(k, poses, rng):
    """Rays of the target by name, and coordinates in the padded volumes."""
    x, y = rng.integers(0, WIDTH, RAYS), rng.integers(0, HEIGHT, RAYS)
    camera = np.stack([x, y, np.ones(RAYS)], -1) @ np.linalg.inv(k[-1]).T
    directions, origin = camera @ poses[-1, :3, :3], -poses[-1, :3, :3].T @ poses[-1, :3, 3]
    regular, jitter = np.linspace(NEAR, FAR, SAMPLES), rng.uniform(size=(RAYS, SAMPLES)).astype(np.float32)
    borders = np.concatenate([[NEAR], (regular[1:] + regular[:-1]) / 2, [FAR]])
    depths = borders[:-1] + np.diff(borders) * jitter
    points = origin + depths[..., None] * directions[:, None]
    pixels, depth = seen(k[0], poses[0], points)
    out = dict(ray_px=x, ray_py=y, u_jitter=jitter, z_lin=regular, z_jit=depths, rays_d=directions, rays_o=origin)
    for padding in (0, PADDING):
        place = lambda i, n, padding=padding: (pixels[..., i] / (4 * n - 1) * n + padding) / (n + 2 * padding)
        coords = [place(0, COLUMNS), place(1, ROWS), (depth - NEAR) / (FAR - NEAR)]
        out[f"rays_ndc_pad{padding}"] = np.stack(coords, -1)
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return out | {"rays_pts": points, "view_dir": unit @ poses[0, :3, :3].T}


def colours_at(images, k, poses, points):
    """(R, S, 4 V) colours, and whether they are inside."""
    parts = []
    for image, inner, pose in zip(images[:-1], k, poses, strict=False):
        pixels, _ = seen(inner, pose, points)
        u, v = pixels[..., 0], pixels[..., 1]
        inside = (u > 0) & (u < WIDTH - 1) & (v > 0) & (v < HEIGHT - 1)
        parts += [read(image, u, v, "nearest"), inside[..., None]]
    return np.concatenate(parts, -1)


def looked_up(volume, coords):
    """(R, S, C) of a volume (C, D, h, w), fading to 0 outside."""
    cells = [coords[..., 2 - i] * (n - 1) for i, n in enumerate(volume.shape[1:])]
    return np.stack([map_coordinates(x, cells, order=1, mode="grid-constant") for x in volume], -1)


def rendered(params, take):
    """What the rays show, by name."""
    coords = take["rays_ndc_pad8"]
    features = np.concatenate([take["ray_feats_pad8"], take["ray_colors"]], -1)
    flat = (jnp.asarray(x.reshape(RAYS * SAMPLES, -1), jnp.float32) for x in (coords, features))
    direction = jnp.asarray(np.repeat(take["view_dir"], SAMPLES, 0), jnp.float32)
    density, colour = (np.asarray(x, np.float64) for x in mvsnerf.field(params.field, *flat, direction))
    alpha, colour = 1 - np.exp(-density.reshape(RAYS, SAMPLES)), colour.reshape(RAYS, SAMPLES, 3)
    weights = alpha * np.cumprod(np.concatenate([np.ones((RAYS, 1)), 1 - alpha[:, :-1]], 1), 1)
    waves = [wave(coords[:3, ..., None, :] * 2.0 ** np.arange(10)[:, None]) for wave in (np.sin, np.cos)]
    return {
        "raw_rgbsigma": np.concatenate([colour, density.reshape(RAYS, SAMPLES, 1)], -1), "alpha": alpha,
        "weights": weights, "rgb_map": (weights[..., None] * colour).sum(1),
        "depth_map": (weights * take["z_jit"]).sum(1),
        "pe_xyz": np.concatenate([coords[:3], *(wave.reshape(3, SAMPLES, 30) for wave in waves)], -1),
    }  # fmt: skip


def networks(params, stored, sources):
    """What the library's networks give; compiled once with `check_parity`, which is told no size."""
    features = [parity_arrays.features_of(p.features, sources.images)[2] for p in (params, stored)]
    built = [parity_arrays.volumes_of(params, sources, planes=planes, padding=PADDING) for planes in (PLANES, FULL)]
    return {
        "feats_train": features[0], "feats_eval": features[1], "cost_pad8_train": built[0][0],
        "vol_pad8_train": built[0][1], "vol16_train_strided": built[1][1][:, ::8, ::4, ::4],
    }  # fmt: skip


def made_record(params, stored):
    """float32 arrays by published name, of parameters whose norms use the images' statistics and the stored ones."""
    rng = np.random.default_rng(5)
    (k, poses), images = cameras(rng), rng.uniform(size=(VIEWS + 1, HEIGHT, WIDTH, 3)).astype(np.float32)
    known = (images[:-1], Camera(*(x[:-1].astype(np.float32) for x in (k, poses))), np.float32(NEAR), np.float32(FAR))
    take = networks(params, stored, jax.tree.map(jnp.asarray, mvsnerf.Sources(*known)))
    take |= swept(k, poses) | sampled(k, poses, rng)
    u, v = ((take["grid1_pad8"][::5, ..., i] + 1) * (n - 1) / 2 for i, n in enumerate((COLUMNS, ROWS)))
    warped = read(np.moveaxis(take["feats_train"][1], 0, -1), u, v, "constant")
    take |= {
        "imgs01": np.moveaxis(images, -1, 1), "w2cs": poses, "c2ws": np.linalg.inv(poses), "intrinsics": k,
        "imgs_norm": np.moveaxis((images - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225], -1, 1),
        "near_far": np.array([NEAR, FAR]), "depth_values": np.linspace(NEAR, FAR, PLANES)[None],
        "warp1_pad8_train": np.moveaxis(warped, -1, 0), "ray_colors": colours_at(images, k, poses, take["rays_pts"]),
        "ray_feats_pad8": looked_up(take["vol_pad8_train"], take["rays_ndc_pad8"]),
    }  # fmt: skip
    take |= rendered(params, take)
    return {name: np.asarray(array, np.float32) for name, array in take.items()}
