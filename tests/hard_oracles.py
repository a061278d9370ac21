"""What the functions of `hard_cases` should give, one number at a time in float64, where no closed form is at hand."""

import numpy as np


def image_at(image, u, v):
    """An image's (C,) between its pixels, 0 outside."""
    height, width, channels = image.shape
    if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
        return np.zeros(channels)
    out = np.zeros(channels)
    for column in range(width):
        for row in range(height):
            share = max(0.0, 1 - abs(u - column)) * max(0.0, 1 - abs(v - row))
            out += share * np.asarray(image[row, column], np.float64)
    return out


def carried(image, homography, rows, columns):
    """An image on the plane of a homography, (rows, columns, C); 0 behind the camera and outside."""
    out = np.zeros((rows, columns, image.shape[-1]))
    for row in range(rows):
        for column in range(columns):
            u, v, w = np.asarray(homography, np.float64) @ [column, row, 1]
            if w > 1e-6:
                out[row, column] = image_at(image, u / w, v / w)
    return out


def volume_at(volume, cells):
    """(N, C) of a volume (D, H, W, C) between its cells."""
    out = []
    for cell in np.asarray(cells, np.float64):
        total = np.zeros(volume.shape[-1])
        for index in np.ndindex(*volume.shape[:3]):
            total += np.prod(np.maximum(0, 1 - np.abs(cell - index))) * volume[index]
        out.append(total)
    return np.array(out)


def encoded(x, levels):
    """x, then for each octave the sines of all coordinates and their cosines."""
    x = [float(value) for value in x]
    out = list(x)
    for octave in range(levels):
        out += [np.sin(2**octave * value) for value in x] + [np.cos(2**octave * value) for value in x]
    return np.array(out)


def cube_from_world(points, k, near, far, height, width):
    """Places in the frustum of a camera at the origin, even in inverse depth; nearer than near / 1000 counts as that.

    A point that is not in front has no pixel: its homogeneous one is taken as it is.
    """
    out = []
    for point in np.asarray(points, np.float64):
        u, v, _ = k @ point / (point[2] if point[2] > 1e-6 else 1)
        inverse = 1 / max(point[2], near / 1000)
        out.append([u / (width - 1), v / (height - 1), (1 / near - inverse) / (1 / near - 1 / far)])
    return np.array(out)


def world_from_cube(coords, k, near, far, height, width):
    """The inverse in front of the camera; nothing is farther than 1000 far."""
    out = []
    for x, y, z in np.asarray(coords, np.float64):
        depth = 1 / max(1 / near - z * (1 / near - 1 / far), 1 / (1000 * far))
        out.append(np.linalg.inv(k) @ [x * (width - 1), y * (height - 1), 1] * depth)
    return np.array(out)
