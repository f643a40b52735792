"""Draw the small figures of the README: uses of DeepDetect.

python docs/figures/uses.py    # writes docs/images/use-*.jpg

The photographs come with scikit-image: the Motorcycle pair of Middlebury 2014 (Scharstein et al.;
free to use and publish with citation), the coffee cup (Rachel Michetti, CC0) and the astronaut
(NASA, public domain). The model of many photographs is docs/images/fountain-dense-front.jpg.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from day_dark_blurred import (
    BASELINE_MM,
    CENTRE_LEFT_PX,
    CENTRE_RIGHT_PX,
    FOCAL_PX,
    draw_model,
)
from layout import write_jpeg
from PIL import Image, ImageOps

from deepdetect import (
    Calibration,
    Camera,
    DeepDetect,
    match_images,
    reconstruct,
    register,
    stitch,
)
from deepdetect._shared.opencv import cv2
from deepdetect.reconstruction import Reconstruction
from deepdetect.tracking import Tracker, TrackingOptions, point_candidates
from deepdetect.tracking.tracks import TrackDrawer
from deepdetect_lab.datasets import load_motorcycle

FOLDER = Path(__file__).parents[1] / "images"
SIZE = (240, 160)
QUALITY = 80
LINES = 40

TILTED = np.array([[0.86, 0.22, -20.0], [-0.16, 0.92, 60.0], [1e-4, 3e-4, 1.0]])
"""Homography that maps the astronaut to a view from the side. Chosen by hand."""

TURNS_DEG = (-14, 0, 14)
"""Rotations, in degrees, of the camera that takes the parts of the panorama. Chosen by hand."""

FOCAL_CUP_PX = 700
FRAMES, STEP_PX = 14, np.array([5.0, 2.0])
"""Number of frames of the video, and shift per frame of the window that moves over the cup. Chosen
by hand."""


def main() -> None:
    """Write all figures."""
    from skimage import data

    pair = load_motorcycle()
    matches = match_images(pair.left, pair.right, DeepDetect())
    pictures = {
        "match": matches.draw(pair.left, pair.right, lines=LINES),
        "register": registered(data.astronaut()),
        "stitch": panorama(data.coffee()),
        "pair": draw_model(model_of(pair.left, pair.right)),
        "many": np.asarray(Image.open(FOLDER / "fountain-dense-front.jpg").convert("RGB")),
        "track": tracked(data.coffee()),
    }
    for name, picture in pictures.items():
        write_jpeg(fitted(picture), FOLDER / f"use-{name}.jpg", QUALITY)


def registered(rgb: np.ndarray) -> np.ndarray:
    """Draw a view of a photograph from the side, and a checkerboard of both after registration."""
    side = cv2.warpPerspective(rgb, TILTED, rgb.shape[1::-1])
    return np.concatenate([side, register(rgb, side).checkerboard()], axis=1)


def panorama(rgb: np.ndarray) -> np.ndarray:
    """Draw a panorama of the views that a rotating camera has of a photograph."""
    height, width = rgb.shape[:2]
    camera = np.array([[FOCAL_CUP_PX, 0, width / 2], [0, FOCAL_CUP_PX, height / 2], [0, 0, 1]])
    views = []
    for turn in np.deg2rad(TURNS_DEG):
        rotation = cv2.Rodrigues(np.array([0, turn, 0]))[0]
        seen = cv2.warpPerspective(
            rgb, camera @ rotation @ np.linalg.inv(camera), (width, height), flags=cv2.INTER_CUBIC
        )
        views.append(seen[60:340, 170:430])
    return stitch(views, projection="cylindrical").image


def model_of(left: np.ndarray, right: np.ndarray) -> Reconstruction:
    """Reconstruct the pair."""
    size = (left.shape[1], left.shape[0])
    cameras = (Camera(size, FOCAL_PX, centre) for centre in (CENTRE_LEFT_PX, CENTRE_RIGHT_PX))
    return reconstruct(left, right, calibration=Calibration(*cameras, BASELINE_MM))


def tracked(rgb: np.ndarray) -> np.ndarray:
    """Draw the tracks of points in a window that moves over a photograph."""
    tracker = Tracker(point_candidates(), TrackingOptions(max_keypoints=120))
    drawer = TrackDrawer(FRAMES)
    for number in range(FRAMES):
        x, y = np.rint(number * STEP_PX + [60, 50]).astype(int).tolist()
        frame = rgb[y : y + 280, x : x + 420]
        picture = drawer.draw(frame, tracker.update(frame, number=number))
    return picture


def fitted(picture: np.ndarray) -> np.ndarray:
    """Scale an image to the cell: pad it with white if it is much wider, otherwise crop it."""
    image = Image.fromarray(picture)
    if image.width > 2.2 * image.height:
        return np.asarray(ImageOps.pad(image, SIZE, Image.Resampling.LANCZOS, color="white"))
    return np.asarray(ImageOps.fit(image, SIZE, Image.Resampling.LANCZOS))


if __name__ == "__main__":
    main()
