"""What a simulated scene is: arrays only, so that scenes of one shape share one compiled program.

B        bodies: boxes first, then balls
N        times a scene has tables for
T        texels of the packed atlas, all levels
unit body  the box [-1, 1]^3 or the ball of radius 1
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from zestjax.base.types import Array, Scalar
from zestjax.cameras import Camera


class Motion(NamedTuple):
    """How each body's joint moves; `zestjax.simulate.motion` turns it into matrices.

    With s = sin(rate * t + phase): offset = velocity * t + sway * s, rotation vector = spin * t + swing * s,
    stretch = identity + strain * s. A chain of joints inherits offsets and rotations, not stretches.

    joint: (B, 4, 4) parent_from_joint before any motion, rigid.
    parent: (B,) int32 number of the parent body, -1 for the world.
    velocity, sway: (B, 3) world units per frame, world units, in the axes of the resting joint.
    spin, swing: (B, 3) radians per frame, radians.
    strain: (B, 3, 3) relative stretch and shear.
    rate, phase: (B,) radians per frame, radians.
    """

    joint: Array
    parent: Array
    velocity: Array
    sway: Array
    spin: Array
    swing: Array
    strain: Array
    rate: Array
    phase: Array


class Bodies(NamedTuple):
    """Shapes, looks and motion of the bodies of one kind.

    shape: (B, 4, 4) joint_from_unit, affine and never singular.
    present: (B,) bool; an absent body is seen by no ray.
    hollow: (B,) bool; seen from inside, casts no shadow: the room around a scene.
    texture: (B, 3) int32 number in the atlas of the texture of the faces across x, y and z.
    tiling: (B, 3) texture tiles per unit-body half-length.
    offset: (B, 2) texture tiles.
    tint: (B, 3) factor on the texture.
    gloss: (B,) strength of the highlight in [0, 1]; used where the scene has highlights.
    motion: `Motion`.
    """

    shape: Array
    present: Array
    hollow: Array
    texture: Array
    tiling: Array
    offset: Array
    tint: Array
    gloss: Array
    motion: Motion


class Effects(NamedTuple):
    """Effects as data; None is absent from the compiled program.

    shadows: () darkness of cast shadows in [0, 1].
    specular: () factor on the bodies' gloss.
    motion_blur: () shutter time in frames; bodies blur, the camera does not.
    exposure: (N, 3) gain of each time and channel.
    noise: () standard deviation of the sensor's noise, applied only where a key is given.
    """

    shadows: Scalar | None = None
    specular: Scalar | None = None
    motion_blur: Scalar | None = None
    exposure: Array | None = None
    noise: Scalar | None = None


class Scene(NamedTuple):
    """boxes, balls: `Bodies`. atlas: (T,) uint32 packed texels (`zestjax.simulate.textures`). light: (3,) world
    position of the point light. ambient: () share of light that comes from everywhere, in [0, 1].
    effects: `Effects`."""

    boxes: Bodies
    balls: Bodies
    atlas: Array
    light: Array
    ambient: Scalar
    effects: Effects


class Frame(NamedTuple):
    """What one camera sees at one time.

    image: (H, W, 3) RGB in [0, 1], anti-aliased.
    depth: (H, W) z at the pixel's centre, world units; infinite where a ray hits nothing.
    body: (H, W) int32 number of the body at the pixel's centre, -1 where a ray hits nothing.
    point: (H, W, 3) world point at the pixel's centre.
    """

    image: Array
    depth: Array
    body: Array
    point: Array


@dataclass(frozen=True)
class SimulatedScene:
    """A scene with its cameras.

    name: of the scene. scene: `Scene`. rig: (C,) `Camera`, every camera there is. taken: (N,) int, the camera that
    took each frame. near, far: depth bounds that hold for every camera at every time. height, width: of the images
    the rig's intrinsics are for.
    """

    name: str
    scene: Scene
    rig: Camera
    taken: np.ndarray
    near: float
    far: float
    height: int
    width: int

    @property
    def frames(self) -> int:
        """N."""
        return len(self.taken)
