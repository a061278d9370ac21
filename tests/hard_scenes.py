"""Named hard cases of the whole system, each with its cause: what is done to a training step's parameters and `Batch`.

A step must be finite there, in every loss and every gradient, and agree with float64; a batch of scenes must not be
spoilt by the one that is hard. `hard_cases` is the same for single functions; `test_hard_scenes` runs these.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import stage


class HardScene(NamedTuple):
    """name. cause: what breaks a naive system. change: `(params, batch, system) -> (params, batch)`. tolerance: of
    losses and of the gradient as a whole against float64's."""

    name: str
    cause: str
    change: Any
    tolerance: float = 3e-3


def of_inputs(change):
    return lambda params, batch, system: (params, batch._replace(inputs=change(batch.inputs)))


def of_truth(**changes):
    """Leaves of the truth set to one value."""

    def change(params, batch, system):
        filled = {name: np.full_like(getattr(batch.truth, name), value) for name, value in changes.items()}
        return params, batch._replace(truth=batch.truth._replace(**filled))

    return change


def of_params(part, **heads):
    """Biases of a field's heads: its density, blend or flow as extreme as they come."""

    def change(params, batch, system):
        field = getattr(params, part)
        named = {n: getattr(field.net, n) for n in heads if getattr(field.net, n) is not None}
        pushed = {n: head._replace(bias=jnp.full_like(head.bias, heads[n])) for n, head in named.items()}
        return params._replace(**{part: field._replace(net=field.net._replace(**pushed))}), batch

    return change


def at_time(time):
    """The target's time is another; slots beside it that the video does not have are not valid."""

    def change(params, batch, system):
        inputs, frames = stage.inputs_of(system, time=time)
        batch = batch._replace(inputs=inputs)
        if batch.evidence is not None:
            whole = stage.prepared(system).evidence
            batch = batch._replace(evidence=jax.tree.map(lambda x: x[frames], whole))
        return params, batch

    return change


def both(change):
    return of_inputs(lambda inputs: inputs._replace(key=change(inputs.key), slots=change(inputs.slots)))


def painted(value):
    return both(lambda f: f._replace(images=jnp.full_like(f.images, value)))


def posed(change):
    """The source cameras' (V, 4, 4) poses changed."""
    turned = lambda f: f.cameras._replace(camera_from_world=change(np.asarray(f.cameras.camera_from_world)))
    return both(lambda f: f._replace(cameras=turned(f)))


def first_only(x):
    return np.repeat(np.asarray(x)[:1], len(x), 0)


def duplicates(f):
    noise = np.random.default_rng(0).normal(size=f.images.shape).astype(np.float32)
    cameras = jax.tree.map(first_only, f.cameras)
    return f._replace(images=jnp.asarray(first_only(f.images) + 1e-6 * noise), cameras=cameras)


def target_pose(x=0.0, z=0.0):
    """The target's camera moved by (x, 0, z) from the origin."""
    pose = np.eye(4, dtype=np.float32)
    pose[0, 3], pose[2, 3] = -x, -z
    return of_inputs(lambda i: i._replace(camera=i.camera._replace(camera_from_world=jnp.asarray(pose))))


def bounds(near, far):
    return of_inputs(lambda i: i._replace(near=np.float32(near), far=np.float32(far)))


LAST = stage.FRAMES - 1
TURNED = np.diag([-1.0, 1, -1, 1]).astype(np.float32)
SCENES = [
    HardScene("as it is", "nothing", lambda params, batch, system: (params, batch)),
    HardScene("the first frame", "no neighbour before it", at_time(0)),
    HardScene("the last frame", "no neighbour after it", at_time(LAST)),
    HardScene("before the video", "no neighbour at all; normalised time below -1", at_time(-4)),
    HardScene("after the video", "no neighbour at all; normalised time above 1", at_time(LAST + 4)),
    HardScene("no frame is valid", "0 / 0 in every mean over views", both(
        lambda f: f._replace(valid=np.zeros_like(f.valid)))),
    HardScene("near-duplicate frames", "variances of rounding errors", both(duplicates)),
    HardScene("a camera that stands still", "no parallax", posed(first_only)),
    HardScene("cameras that look away", "every point is behind every source", posed(lambda pose: TURNED @ pose)),
    HardScene("sources beyond the scene", "some planes cut the sources' own", posed(
        lambda pose: pose + np.float32(-3) * np.eye(4, dtype=np.float32)[2][:, None] * np.eye(4, dtype=np.float32)[3])),
    HardScene("black", "constant images", painted(0.0)),
    HardScene("white", "saturated images", painted(1.0), 1e-2),
    HardScene("grey", "no texture", painted(0.5)),
    HardScene("a target inside the scene", "points at the camera's centre", target_pose(z=3.9)),
    HardScene("a target that sees nothing", "empty rays", target_pose(x=1e3)),
    HardScene("a thin frustum", "depths that differ by rounding", bounds(3.0, 3.0001), 0.1),
    HardScene("an endless frustum", "planes at infinity", bounds(1e-3, 1e5)),
    HardScene("everything moves", "empty static masks", of_truth(moving=1)),
    HardScene("nothing moves", "empty motion masks", of_truth(moving=0, flow_valid=0)),
    HardScene("nothing is known", "empty masks everywhere", of_truth(known=0, flow_valid=0, static_valid=0)),
    HardScene("empty", "density 0: depth / opacity", of_params("static", density=-1e4)),
    HardScene("walls", "density 1e10: products of zeros", of_params("static", density=1e10)),
    HardScene("both fields are walls", "no light passes", lambda p, b, c: of_params("dynamic", density=1e10)(
        *of_params("static", density=1e10)(p, b, c), c)),
    HardScene("b at 1", "the logarithm of 1 - b", of_params("static", blend=200.0)),
    HardScene("b at 0", "the logarithm of b", of_params("static", blend=-200.0)),
    HardScene("confidence 0", "a division by the confidences' sum", of_params("dynamic", confidence=-200.0)),
    HardScene("flow to the frustum's edge", "tanh saturates; z passes 1", of_params("dynamic", flow=50.0)),
    HardScene("flow to the camera", "z passes 0: points behind the camera", of_params("dynamic", flow=-50.0)),
    HardScene("no flow", "norms at 0: what is left of it is rounding", lambda p, b, c: (p._replace(
        dynamic=p.dynamic._replace(net=p.dynamic.net._replace(
            flow=jax.tree.map(jnp.zeros_like, p.dynamic.net.flow)))), b), 0.05),
]  # fmt: skip
