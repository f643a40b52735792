"""A camera and its pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .camera import Camera
from .triangulation import cross_matrix


@dataclass(frozen=True, eq=False)
class PosedView:
    """An image whose camera is known.

    Attributes:
        name: of the image.
        camera: its pinhole camera, centre of the first pixel (0, 0).
        rotation, translation: (3, 3) and (3,) float64: a point X of the world is
            rotation @ X + translation in the camera's frame, x right, y down, z forward.

    Example:
        >>> view = PosedView("a.jpg", Camera((640, 480), 500.0), np.eye(3), np.array([1.0, 0, 0]))
        >>> view.centre.tolist(), view.project(np.array([[0.0, 0.0, 10.0]]))[0].tolist()
        ([-1.0, 0.0, 0.0], [[369.5, 239.5]])
    """

    name: str
    camera: Camera
    rotation: np.ndarray
    translation: np.ndarray

    @property
    def centre(self) -> np.ndarray:
        """(3,) float64, where the camera stands."""
        return np.asarray(-self.rotation.T @ self.translation)

    @property
    def projection(self) -> np.ndarray:
        """(3, 4) float64 projection matrix, from the world to pixels."""
        return self.camera.matrix @ np.column_stack([self.rotation, self.translation])

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (N, 2) in pixels, and depths (N,), of points (N, 3) of the world."""
        seen = np.asarray(points, np.float64) @ self.rotation.T + self.translation
        return self.camera.project(seen), seen[:, 2]

    def corners(self, depth: float) -> np.ndarray:
        """Return the (4, 3) corners of what it sees at a depth, around the image."""
        width, height = self.camera.size
        pixels = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
        rays = self.camera.rays(pixels) * depth
        return np.asarray((rays - self.translation) @ self.rotation)


def relative_fundamental(first: PosedView, second: PosedView) -> np.ndarray:
    """Return the fundamental matrix of two views, (3, 3) with x1^T F x0 = 0.

    Example:
        >>> camera = Camera((640, 480), 500.0)
        >>> views = [PosedView("", camera, np.eye(3), np.array([x, 0.0, 0])) for x in (0, -1)]
        >>> matrix = relative_fundamental(*views)
        >>> (matrix / matrix[2, 1]).round(9) + 0.0  # matches lie on the same row
        array([[ 0.,  0.,  0.],
               [ 0.,  0., -1.],
               [ 0.,  1.,  0.]])
    """
    rotation = second.rotation @ first.rotation.T
    translation = second.translation - rotation @ first.translation
    inverses = [np.linalg.inv(view.camera.matrix) for view in (first, second)]
    return np.asarray(inverses[1].T @ cross_matrix(translation) @ rotation @ inverses[0])
