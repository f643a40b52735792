"""Find the scale and place of a model by GPS, ground control points, or a known distance."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import NoPlaceError, OptionError, ReconstructionError
from ..geometry.camera import PosedView
from ..geometry.similarity import (
    MIN_POINTS,
    MUCH_BETTER,
    WRONG_STDS,
    Similarity,
    SimilarityFit,
    changes,
    fit_similarity,
)
from ..io.gps import ELLIPSOID, SEA_LEVEL, TAKE_OFF, GpsFix, read_gps
from ..io.image import find_images
from .colmap import import_pycolmap
from .control_points import ControlRow
from .mapping import SparseModel

GPS_ACCURACY_M, CONTROL_ACCURACY_M = 3.0, 0.1
"""Assumed accuracies: of GPS positions that state none, typical of receivers in the open, and of
control points, which are surveyed to centimetres and marked to within a few pixels."""

MAX_SCALE_STD, MAX_HEADING_STD_DEG = 0.25, 20.0
"""A model is georeferenced only if the relative standard deviation of its scale, and the standard
deviation of its direction to north, are below these limits. Chosen by hand."""

MAX_OPEN_AXIS_DEG = 10.0
"""A note warns if the positions alone leave the standard deviation of a rotation above this."""

GRAVITY_STD_DEG, UPRIGHT_STD_DEG, AHEAD_STD_DEG = 2.0, 5.0, 25.0
"""Assumed standard deviations: of a gimbal's angles; without a gimbal, of image rows from level,
and of the mean of all optical axes from level. Chosen by hand."""

DOWNWARD_SHARE = 0.1
"""Without a gimbal, "down" is first taken as the mean direction of the image columns plus this
weight times the mean optical axis, because cameras look down more often than up. Chosen by hand."""

MAX_DISTANCE_PX = 15.0
"""An end of a known distance stands for a point of the model that projects to within this distance
of the given pixel. Chosen by hand."""

MAX_BEND = 0.05
"""A bent model can explain residuals up to this fraction of the points' extent. Chosen by hand."""

READINGS: dict[str, tuple[list[int], float]] = {
    "heights are in feet": ([0, 1, 2], 0.3048),
    "heights are in metres": ([0, 1, 2], 1 / 0.3048),
    "x and y are exchanged": ([1, 0, 2], 1),
}
"""Mistakes in control points that leave them plausible, each with its correction: the order of the
axes, and the factor of the heights."""

CAUSES = "the units, the order of the columns, the coordinate system, and the names of the images"

NEARLY_A_LINE = "the positions lie nearly on a line: the cameras are assumed to be upright"


@dataclass(frozen=True)
class Origin:
    """Origin of a model: WGS 84 latitude and longitude in degrees, and height in metres."""

    latitude: float
    longitude: float
    height: float

    def to_enu(self, places: np.ndarray) -> np.ndarray:
        """Convert (N, 3) latitudes, longitudes, heights to metres east, north, up of the origin."""
        return np.asarray(_ellipsoid().ellipsoid_to_enu(places, *vars(self).values()))

    def to_utm(self, enu: np.ndarray) -> tuple[np.ndarray, int]:
        """Convert (N, 3) metres to UTM in the origin's zone; also return the zone's EPSG number."""
        # pycolmap uses the UTM zone of the first point, so the origin is put first.
        all_ = np.vstack([np.zeros((1, 3)), np.asarray(enu, np.float64)])
        places = _ellipsoid().enu_to_ellipsoid(all_, *vars(self).values())
        found, zone = _ellipsoid().ellipsoid_to_utm(places)
        return np.asarray(found)[1:], (32600 if self.latitude >= 0 else 32700) + int(zone)


def _ellipsoid() -> Any:
    pycolmap = import_pycolmap()
    return pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)


@dataclass(frozen=True, eq=False)
class Georeference:
    """Scale and place of a model, and how they were found.

    Attributes:
        similarity: similarity from the frame of the mapping to the world.
        source: "GPS", "ground control points", or "known distance", which gives only a scale.
        origin: origin of the world frame (east, north, up); None for a known distance.
        residuals: given position minus position in the model, (3,) in metres east, north and up, by
            name of the image (GPS) or of the control point.
        wrong: images or control points that were left out, because they contradict the others.
        fit: the fitted similarity with its uncertainty; None for a known distance.
        heights: what heights are measured from, such as "above sea level"; they are kept as given.
    """

    similarity: Similarity
    source: str
    origin: Origin | None = None
    residuals: Mapping[str, np.ndarray] = field(default_factory=dict)
    wrong: tuple[str, ...] = ()
    fit: SimilarityFit | None = None
    heights: str = "unknown"

    def summary(self) -> dict[str, Any]:
        """Return the georeference as plain Python types for JSON."""
        if self.origin is None or self.fit is None:
            return {"source": self.source}
        good = np.array([r for name, r in self.residuals.items() if name not in self.wrong])
        up = np.abs(good[:, 2])[np.isfinite(good[:, 2])]
        alone = round(self.fit.axis_std_deg_of_targets, 2)
        crs = "EPSG:4979" if self.heights == ELLIPSOID else "EPSG:4326"
        return {
            "source": self.source,
            "axes": "metres east, north and up of the origin",
            "origin": vars(self.origin) | {"crs": crs, "height_is": self.heights},
            "utm_crs": f"EPSG:{self.origin.to_utm(np.zeros((1, 3)))[1]}",
            "used": len(good),
            "wrong": list(self.wrong),
            "median_residual_across_m": _rounded(np.median(np.linalg.norm(good[:, :2], axis=1))),
            "median_residual_up_m": _rounded(np.median(up)) if len(up) else None,
            "scale_std_percent": round(100 * self.fit.scale_std, 2),
            "axes_std_deg": self.fit.axes_std_deg.round(2).tolist(),
            "least_certain_axis_std_deg_by_these_alone": alone,
            "note": NEARLY_A_LINE if alone > MAX_OPEN_AXIS_DEG else None,
            "residuals_m": {name: [*map(_rounded, r)] for name, r in self.residuals.items()},
        }


def _rounded(value: float) -> float | None:
    return None if np.isnan(value) else round(float(value), 3)


def georeference(
    sparse: SparseModel,
    points: np.ndarray,
    folder: Path,
    control: Sequence[ControlRow] | None = None,
    scale_by: tuple[float, str, str] | None = None,
) -> Georeference | str:
    """Find the scale and place of a model, or return a sentence on why even the scale is unknown.

    `points` (N, 3) are the dense points, and `folder` holds the images. Ground control points are
    used instead of GPS. A known distance (see `MultiViewOptions`) alone determines the scale.

    Raises:
        OptionError: an end of the distance is not in the model, or control points are too few.
        NoPlaceError: the control points contradict the model.
    """
    scale = None
    if scale_by is not None:
        scale = scale_by_distance(*scale_by, sparse, np.vstack([sparse.points, points]))
    if control is not None:
        return georeference_by_control_points(sparse, control, scale)
    try:
        return georeference_by_gps(sparse.views, folder, scale)
    except ReconstructionError as error:
        if scale is None:
            return str(error)
    return Georeference(Similarity(scale, np.eye(3), np.zeros(3)), "known distance")


def require_fixes(folder: Path, what: str) -> None:
    """Raise an OptionError if fewer than `MIN_POINTS` images below a folder have a GPS position."""
    found = sum(read_gps(path) is not None for path in find_images(folder))
    if found < MIN_POINTS:
        raise OptionError(
            f"{what} needs {MIN_POINTS} images with a GPS position, and there are {found}: leave "
            "the format out, or give ground control points"
        )


def require_images(
    names: Collection[str],
    control: Sequence[ControlRow] | None,
    scale_by: tuple[float, str, str] | None,
) -> None:
    """Raise an OptionError if `scale_by` names an unknown image, or control points are too few."""
    named = _by_file_name(names)
    if control is not None:
        _seen_by_several(control, named)
    if scale_by is not None:
        for end in scale_by[1:]:
            _image_and_pixel(end, named)


def georeference_by_gps(
    views: Mapping[str, PosedView], folder: Path, scale: float | None = None
) -> Georeference:
    """Find the place of a model by the GPS positions of its images, which are below a folder.

    `scale` is in metres per unit, if known. If no place is found, a ReconstructionError says why.
    """
    fixes = {name: fix for name in views if (fix := read_gps(folder / name)) is not None}
    if len(fixes) < MIN_POINTS:
        raise ReconstructionError(
            f"{len(fixes)} of the images have GPS, but {MIN_POINTS} are needed"
        )
    if assumed := [name for name, fix in fixes.items() if fix.assumed_hemisphere]:
        what = f"the GPS of {len(assumed)} images, such as {assumed[0]}, lacks N or S, or E or W"
        warnings.warn(f"{what}: north and east are assumed", UserWarning, stacklevel=2)
    heights, altitudes = _altitudes([*fixes.values()])
    places = np.array([(fix.latitude, fix.longitude) for fix in fixes.values()])
    places = np.column_stack([places, altitudes])
    stated = [fix.accuracy_m for fix in fixes.values() if fix.accuracy_m is not None]
    accuracy = float(np.median(stated)) if stated else GPS_ACCURACY_M
    level = upright(views, {name: fix.gravity for name, fix in fixes.items()})
    centres = {name: views[name].centre for name in fixes}
    return _place("GPS", centres, places, accuracy, heights, level, scale)


def _altitudes(fixes: Sequence[GpsFix]) -> tuple[str, np.ndarray]:
    """Return the zero level of most altitudes, and the (N,) altitudes; NaN for other levels.

    Heights above take-off are used only if all images state one, as take-off points may differ.
    """
    table = {name: np.full(len(fixes), np.nan) for name in (TAKE_OFF, SEA_LEVEL, ELLIPSOID)}
    for k, fix in enumerate(fixes):
        table[fix.reference][k] = fix.altitude
    above = np.array([fix.above_take_off for fix in fixes])
    if not np.isnan(above).any():
        table[TAKE_OFF] = above
    best = max(reversed(table), key=lambda name: np.isfinite(table[name]).sum())
    return best, table[best]


def _place(
    source: str,
    points: Mapping[str, np.ndarray],
    places: np.ndarray,
    accuracy: float,
    heights: str,
    level: Mapping[str, np.ndarray],
    scale: float | None,
    error: float | None = None,
) -> Georeference:
    """Fit `points` of a model to `places`; `error` is that of control points, in model units."""
    unknown = np.isnan(places[:, 2])
    places = np.where(np.isnan(places), 0 if unknown.all() else np.nanmedian(places[:, 2]), places)
    places[:, 1] = np.unwrap(places[:, 1], period=360)
    latitude, longitude, height = np.median(places, axis=0).tolist()
    origin = Origin(round(latitude, 6), round((longitude + 180) % 360 - 180, 6), round(height, 1))
    targets = origin.to_enu(places)
    targets[unknown, 2] = np.nan
    own = np.array([*points.values()])
    known: Any = {**level, "scale": scale, "accuracy": accuracy}
    fit = None
    with suppress(ReconstructionError):
        fit = fit_similarity(own, targets, **known)
        if not (fit.scale_std < MAX_SCALE_STD and fit.axes_std_deg[2] < MAX_HEADING_STD_DEG):
            fit = None
    if error is not None:
        _check_control_points(fit, points, targets, error, known)
    if fit is None:
        raise ReconstructionError(
            "the GPS positions contradict each other, or lie too close together for their accuracy"
        )
    residuals = dict(zip(points, fit.residuals, strict=True))
    wrong = tuple(name for name, is_wrong in zip(points, fit.wrong, strict=True) if is_wrong)
    heights = "unknown" if unknown.all() else heights
    return Georeference(fit.similarity, source, origin, residuals, wrong, fit, heights)


def _check_control_points(
    fit: SimilarityFit | None,
    points: Mapping[str, np.ndarray],
    targets: np.ndarray,
    error: float,
    known: Mapping[str, Any],
) -> None:
    """Raise a NoPlaceError if control points contradict a model, or may be misread (`READINGS`).

    They contradict the model if most residuals exceed what the accuracy of the targets, the `error`
    of the points in the model, and a bend of the model explain. A bend causes a warning.
    """
    own, names = np.array([*points.values()]), [*points]

    def misfit(found: SimilarityFit, factor: float = 1) -> tuple[np.ndarray, np.ndarray, float]:
        away = np.linalg.norm(np.nan_to_num(found.residuals), axis=1)
        relative = away / np.hypot(known["accuracy"], found.similarity.scale * error) / factor
        return away, relative, float((np.minimum(relative, WRONG_STDS) ** 2).sum())

    likely, worst, cost, bent = CAUSES, "", len(names) * WRONG_STDS**2, False
    if fit is not None:
        away, relative, cost = misfit(fit)
        for k in np.argsort(-away)[:MIN_POINTS]:
            worst += f", {names[k]} by {away[k]:.3g} m"
        # Three points always agree, so at least three more must agree than disagree.
        few = 2 * (relative > WRONG_STDS).sum() <= len(names) - MIN_POINTS
        agreed = few and np.median(relative) < WRONG_STDS
        bent = cost > len(names) and _is_bent(fit, targets)
        likely = "" if agreed or bent else CAUSES
    for reading, (axes, factor) in READINGS.items() if cost > len(names) else ():
        with suppress(ReconstructionError):
            other = fit_similarity(own, targets[:, axes] * [1, 1, factor], **known)
            if misfit(other, min(factor, 1))[2] < MUCH_BETTER * cost:
                likely = f"whether {reading}, which fits far better"
    if likely:
        raise NoPlaceError(f"the ground control points contradict the model{worst}: check {likely}")
    if bent:
        text = f"the model is bent and misses ground control points{worst}: calibrate the camera"
        warnings.warn(f"{text}, or add images that look obliquely", UserWarning, stacklevel=2)


def _is_bent(fit: SimilarityFit, targets: np.ndarray) -> bool:
    """Return whether a bend that grows with the squared distance fits most residuals.

    Each point is compared with a prediction from the others, so random errors are not a bend.
    """
    known = np.isfinite(targets[:, 2])
    at, residuals = targets[known], fit.residuals[known]
    if len(at) < MIN_POINTS:
        return False
    moves = changes(at)
    bends = (at[:, :2] ** 2).sum(axis=1)[:, None, None] * np.eye(3)
    misses = []
    for used in (moves, np.concatenate([moves, bends], axis=2)):
        left = residuals.copy()
        for k in range(len(at)):
            others = np.arange(len(at)) != k
            matrix = used[others].reshape(-1, used.shape[2])
            left[k] -= used[k] @ np.linalg.lstsq(matrix, residuals[others].ravel())[0]
        misses.append(np.median(np.linalg.norm(left, axis=1)))
    straight, bent = misses
    return bool(straight < MAX_BEND * at.std(axis=0).max() and bent < MUCH_BETTER * straight)


def upright(
    views: Mapping[str, PosedView], gravities: Mapping[str, np.ndarray | None] = {}
) -> dict[str, np.ndarray]:
    """Return `fit_similarity`'s arguments `up` (a unit vector), `level` and `level_stds`.

    If a gimbal reports gravity, directions perpendicular to gravity are level. Otherwise, image
    rows and, less certainly, optical axes are assumed to be level.
    """
    level, stds, down = [], [], []
    for name, view in views.items():
        gravity = gravities.get(name)
        if gravity is not None:
            down.append(view.rotation.T @ gravity)
            level += [*np.linalg.svd(down[-1][None])[2][1:]]
            stds += 2 * [GRAVITY_STD_DEG]
        else:
            # All cameras may be tilted alike, so more of them do not make the mean more certain.
            level += [view.rotation[0], view.rotation[2]]
            stds += [UPRIGHT_STD_DEG, AHEAD_STD_DEG * np.sqrt(len(views))]
    up = -np.mean(down, axis=0) if down else np.zeros(3)
    if not down:  # up is perpendicular to all rows, as in Brown and Lowe's panoramas
        across, *others = np.array([view.rotation for view in views.values()]).swapaxes(0, 1)
        above = -(others[0] + DOWNWARD_SHARE * others[1]).mean(axis=0)
        up = np.linalg.solve(across.T @ across / len(across) + 1e-3 * np.eye(3), above)
    up /= np.linalg.norm(up)
    return {"up": up, "level": np.array(level), "level_stds": np.radians(stds)}


def georeference_by_control_points(
    sparse: SparseModel, control: Sequence[ControlRow], scale: float | None = None
) -> Georeference:
    """Find the place of a model by the control points marked in two or more of its images."""
    seen = _seen_by_several(control, _by_file_name(sparse.images))
    points = {name: _triangulated(sparse, rows) for name, rows in seen.items()}
    places = np.array([next(iter(rows.values())).place for rows in seen.values()])
    views = [(sparse.images[image].view, point) for point in seen for image in seen[point]]
    pixels = [np.linalg.norm(points[k] - v.centre) / v.camera.focal_px[0] for v, k in views]
    error = float(np.median(pixels) * np.median(sparse.errors))
    what = "ground control points", points, places, CONTROL_ACCURACY_M, control[0].heights
    return _place(*what, upright(sparse.views), scale, error)


def _seen_by_several(
    control: Sequence[ControlRow], names: Mapping[str, str]
) -> dict[str, dict[str, ControlRow]]:
    """Return the control points marked in two or more of the images, by name, then by image.

    `names` maps image names in the file to full names. Rows with equal places are one point even if
    their names differ, because remarks on the mark may follow a name.
    """
    rows: dict[str, dict[str, ControlRow]] = {}
    place_of: dict[str, str] = {}
    for row in control:
        if row.image in names:
            place = str(row.place)  # as text, NaN is equal to itself
            rows.setdefault(place, {})[names[row.image]] = row
            if place_of.setdefault(row.name, place) != place:
                raise NoPlaceError(f"{row.name} is the name of two control points: rename one")
    seen = {next(iter(each.values())).name: each for each in rows.values() if len(each) > 1}
    if len(seen) < MIN_POINTS:
        raise OptionError(
            f"{len(seen)} ground control points are marked in two or more images of the model, but "
            f"{MIN_POINTS} are needed: mark more points, and name each image by its file, with the "
            "folder if two files have the same name"
        )
    return seen


def _by_file_name(names: Collection[str]) -> dict[str, str]:
    """Map names that users may give (full names, and file names if unique) to full names."""
    counts = Counter(Path(name).name for name in names)
    alone = {Path(name).name: name for name in names if counts[Path(name).name] == 1}
    return {**alone, **{name: name for name in names}}


def _triangulated(sparse: SparseModel, rows: Mapping[str, ControlRow]) -> np.ndarray:
    """Return the point (3,) that is nearest to the lines of sight of a control point's pixels."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for name, row in rows.items():
        view = sparse.images[name].view
        xy = sparse.images[name].intrinsics.to_pinhole(row.xy[None])
        ray = view.rotation.T @ view.camera.rays(xy)[0]
        across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        normal += across
        right += across @ view.centre
    return np.linalg.solve(normal, right)


def scale_by_distance(
    distance_m: float, end0: str, end1: str, sparse: SparseModel, points: np.ndarray
) -> float:
    """Return the metres per unit of a model, from the known distance between two places in it.

    An end is the NAME of an image, for its camera, or NAME:X,Y, for the point of `points` (N, 3)
    that this pixel shows.
    """
    one, other = (_end(end, sparse, points) for end in (end0, end1))
    length = float(np.linalg.norm(one - other))
    if not length > 0:
        raise OptionError(f"{end0} and {end1} are the same place: name two different places")
    return distance_m / length


def _end(end: str, sparse: SparseModel, points: np.ndarray) -> np.ndarray:
    name, pixel = _image_and_pixel(end, _by_file_name(sparse.images))
    image = sparse.images[name]
    if pixel is None:
        return image.view.centre
    xy = image.intrinsics.to_pinhole(pixel[None])
    projected, depth = image.view.project(points)
    distances = np.where(depth > 0, np.linalg.norm(projected - xy, axis=1), np.inf)
    if not (len(points) and distances.min() < MAX_DISTANCE_PX):
        raise OptionError(
            f"the model has no point within {MAX_DISTANCE_PX:g} pixels of {end}: name a pixel with "
            "more texture around it"
        )
    # The point nearest to the camera hides others that are about equally close to the pixel.
    near = np.flatnonzero(distances < distances.min() + 2)
    return np.asarray(points[near[depth[near].argmin()]], np.float64)


def _image_and_pixel(end: str, names: Mapping[str, str]) -> tuple[str, np.ndarray | None]:
    """Parse an end, as in `scale_by_distance`, to an image's full name and a pixel or None."""
    pixel = re.fullmatch(r"(.+):(\d+(?:\.\d+)?),(\d+(?:\.\d+)?)", end)
    name = pixel[1] if pixel else end
    if name not in names:
        raise OptionError(
            f"{name} is not an image of the model: name two of its images, or pixels in images as "
            "NAME:X,Y"
        )
    return names[name], np.array([float(pixel[2]), float(pixel[3])]) if pixel else None
