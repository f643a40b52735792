"""Scale and place of a model: by GPS, ground control points, or a known distance."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._shared.errors import OptionError, ReconstructionError, first_line, require_packages
from ..geometry.camera import PosedView
from ..geometry.similarity import Similarity, SimilarityFit, fit_similarity
from ..io.gps import read_gps
from ..io.image import find_images
from .colmap import import_pycolmap
from .mapping import SparseModel

GPS_ACCURACY_M = 3.0
"""Accuracy of a GPS position that does not state its own: that of usual receivers in the open."""

CONTROL_ACCURACY_M = 0.1
"""Accuracy of ground control points, surveyed to centimetres and marked to within a few pixels."""

MIN_FIXES = 3
"""Number of positions that must agree: with two, the rotation about their line is undetermined."""

MAX_SCALE_STD = 0.25
"""A model gets a place only if the relative standard deviation of its scale is smaller. It is large
if positions lie close together for their accuracy. Chosen by hand."""

MAX_HEADING_STD_DEG = 20.0
"""A model gets a place only if north has a smaller standard deviation. Chosen by hand."""

MAX_OPEN_AXIS_DEG = 10.0
"""The cameras' up decides on an axis if positions alone leave it a larger standard deviation."""

GRAVITY_STD_DEG = 2.0
"""Standard deviation of the angles of a gimbal. Chosen by hand."""

UPRIGHT_STD_DEG, AHEAD_STD_DEG = 5.0, 25.0
"""Standard deviations of the tilt of the rows of a photograph, which are taken to be level, and of
the mean tilt of the optical axes. Chosen by hand."""

DOWNWARD_SHARE = 0.1
"""Weight of the optical axes in the estimate of up, relative to the columns of the images: cameras
look down rather than up. Chosen by hand."""

MAX_DISTANCE_PX = 15.0
"""A named pixel means the point of the model that is seen within this distance. Chosen by hand."""

NEARLY_A_LINE = "they lie nearly on a line: the rotation of the model about it follows from the \
assumption that cameras are held upright"


@dataclass(frozen=True)
class Origin:
    """Origin of a model in WGS 84: its axes go east, north and up from here, in metres."""

    latitude: float
    longitude: float
    height: float

    def to_enu(self, places: np.ndarray) -> np.ndarray:
        """Convert (N, 3) latitudes, longitudes and heights to metres east, north and up."""
        where = self.latitude, self.longitude, self.height
        return np.asarray(_ellipsoid().ellipsoid_to_enu(places, *where))

    def to_utm(self, enu: np.ndarray) -> tuple[np.ndarray, int]:
        """Convert (N, 3) metres to the UTM zone of the origin; also return its EPSG number."""
        where = self.latitude, self.longitude, self.height
        # pycolmap takes the zone of the first point.
        all_ = np.vstack([np.zeros((1, 3)), np.asarray(enu, np.float64)])
        found, zone = _ellipsoid().ellipsoid_to_utm(_ellipsoid().enu_to_ellipsoid(all_, *where))
        return np.asarray(found)[1:], (32600 if self.latitude >= 0 else 32700) + int(zone)


def _ellipsoid() -> Any:
    pycolmap = import_pycolmap()
    return pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)


@dataclass(frozen=True, eq=False)
class Georeference:
    """Scale and place of a model, and how they were found.

    Attributes:
        similarity: from the frame of the mapping to the world.
        source: "GPS", "ground control points" or "known distance", which gives no place.
        origin: origin of the world, whose axes go east, north and up; None without a place.
        residuals: (3,) metres east, north and up from the model to each GPS position, by image, or
            to each control point.
        wrong: names of positions that contradict the others and were left out.
        fit: the fitted similarity with its uncertainty.
    """

    similarity: Similarity
    source: str
    origin: Origin | None = None
    residuals: Mapping[str, np.ndarray] = field(default_factory=dict)
    wrong: tuple[str, ...] = ()
    fit: SimilarityFit | None = None

    def summary(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        if self.origin is None or self.fit is None:
            return {"source": self.source}
        good = np.array([r for name, r in self.residuals.items() if name not in self.wrong])
        up = np.abs(good[:, 2])[np.isfinite(good[:, 2])]
        alone = round(self.fit.axis_std_deg_of_targets, 2)
        return {
            "source": self.source,
            "axes": "metres east, north and up of the origin",
            "origin": vars(self.origin) | {"crs": "EPSG:4979"},
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
    """Find the scale and the place of a model, or return a sentence on why there is no scale.

    Args:
        sparse: the model.
        points: (N, 3) dense points, which can also be ends of a distance.
        folder: folder of the images.
        control: ground control points, which take precedence over GPS.
        scale_by: known distance as in `MultiViewOptions`; its scale takes precedence over both.

    Raises:
        OptionError: the control points or the ends of the distance are not in the model.
        ReconstructionError: the control points contradict the model.
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
    """Raise an OptionError if too few images below a folder have GPS."""
    found = sum(read_gps(path) is not None for path in find_images(folder))
    if found < MIN_FIXES:
        raise OptionError(
            f"{what} needs GPS in {MIN_FIXES} images, and {found} have it: leave the format out, "
            "or give ground control points"
        )


def require_images(
    names: Iterable[str],
    control: Sequence[ControlRow] | None,
    scale_by: tuple[float, str, str] | None,
) -> None:
    """Raise an OptionError if control points or the ends of a distance name unknown images."""
    names = [*names]
    named = {Path(name).name: name for name in names} | {name: name for name in names}
    if control is not None:
        _seen_by_several(control, named)
    if scale_by is not None:
        for end in scale_by[1:]:
            _image_and_pixel(end, named)


def georeference_by_gps(
    views: Mapping[str, PosedView], folder: Path, scale: float | None = None
) -> Georeference:
    """Find the place of a model by the GPS of its images below a folder.

    A known `scale` is in metres per unit of the model. Raises a ReconstructionError that says why
    no place is found.
    """
    fixes = {name: fix for name in views if (fix := read_gps(folder / name)) is not None}
    if len(fixes) < MIN_FIXES:
        raise ReconstructionError(f"{len(fixes)} of the images have GPS, {MIN_FIXES} are needed")
    places = np.array([(fix.latitude, fix.longitude, fix.altitude) for fix in fixes.values()])
    stated = [fix.accuracy_m for fix in fixes.values() if fix.accuracy_m is not None]
    accuracy = float(np.median(stated)) if stated else GPS_ACCURACY_M
    up, level, stds = upright(views, {name: fix.gravity for name, fix in fixes.items()})
    centres = {name: views[name].centre for name in fixes}
    return _place("GPS", centres, places, accuracy, scale, up=up, level=level, level_stds=stds)


def _place(
    source: str,
    points: Mapping[str, np.ndarray],
    places: np.ndarray,
    accuracy: float,
    scale: float | None,
    **upright: Any,
) -> Georeference:
    unknown = np.isnan(places[:, 2])
    places = np.where(np.isnan(places), 0 if unknown.all() else np.nanmedian(places[:, 2]), places)
    latitude, longitude, height = np.median(places, axis=0).tolist()
    origin = Origin(round(latitude, 6), round(longitude, 6), round(height, 1))
    targets = origin.to_enu(places)
    targets[unknown, 2] = np.nan
    problem = ReconstructionError(
        "the GPS positions contradict each other, or lie too close together for their accuracy"
        if source == "GPS"
        else "the ground control points do not agree with the model: check their coordinates, "
        "pixels and image names"
    )
    try:
        fit = fit_similarity(
            np.array([*points.values()]), targets, accuracy, scale=scale, **upright
        )
    except ReconstructionError:
        raise problem from None
    if not (fit.scale_std < MAX_SCALE_STD and fit.axes_std_deg[2] < MAX_HEADING_STD_DEG):
        raise problem
    residuals = dict(zip(points, fit.residuals, strict=True))
    wrong = tuple(name for name, is_wrong in zip(points, fit.wrong, strict=True) if is_wrong)
    return Georeference(fit.similarity, source, origin, residuals, wrong, fit)


def upright(
    views: Mapping[str, PosedView], gravities: Mapping[str, np.ndarray | None] = {}
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Estimate the direction of up from cameras; also return what `fit_similarity` takes as level.

    Level directions are those across the gravity that a gimbal reports. Without a gimbal, the rows
    of the photographs are taken to be level, and less certainly the optical axes. Returns the unit
    vector up, the level vectors (L, 3) and their standard deviations (L,) in radians.
    """
    level, stds, down = [], [], []
    for name, view in views.items():
        gravity = gravities.get(name)
        if gravity is not None:
            down.append(view.rotation.T @ gravity)
            level += [*np.linalg.svd(down[-1][None])[2][1:]]
            stds += 2 * [GRAVITY_STD_DEG]
        else:
            # All cameras may look up a little: more of them do not make their mean more certain.
            level += [view.rotation[0], view.rotation[2]]
            stds += [UPRIGHT_STD_DEG, AHEAD_STD_DEG * np.sqrt(len(views))]
    up = -np.mean(down, axis=0) if down else np.zeros(3)
    if not down:  # as Brown and Lowe straighten panoramas: up is perpendicular to all rows
        across, *others = np.array([view.rotation for view in views.values()]).swapaxes(0, 1)
        above = -(others[0] + DOWNWARD_SHARE * others[1]).mean(axis=0)
        up = np.linalg.solve(across.T @ across / len(across) + 1e-3 * np.eye(3), above)
    return up / np.linalg.norm(up), np.array(level), np.radians(stds)


class ControlRow(NamedTuple):
    """A ground control point in an image: its name, latitude, longitude, height, and pixel."""

    name: str
    place: tuple[float, float, float]
    image: str
    xy: np.ndarray


def read_control_points(path: str | Path) -> list[ControlRow]:
    """Read a file of ground control points in the format of OpenDroneMap.

    The first line is the coordinate system, such as "EPSG:32633" or "WGS84 UTM 33N". The others are
    `x y z column row image [name]`.
    """
    require_packages("a file of ground control points", "pyproj")
    from pyproj import CRS, Transformer

    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
        system, *lines = [line.strip() for line in lines if line.strip() and line[0] != "#"]
        if zone := re.fullmatch(r"WGS84 UTM (\d+)([NS])", system):
            system = f"EPSG:{(32600 if zone[2] == 'N' else 32700) + int(zone[1])}"
        to_degrees = Transformer.from_crs(CRS.from_user_input(system), 4326, always_xy=True)
        rows = []
        for line in lines:
            x, y, z, column, row, image, *name = line.split()
            longitude, latitude = to_degrees.transform(float(x), float(y))
            xy = np.array([float(column), float(row)])
            place = latitude, longitude, float(z)
            rows.append(ControlRow((name or [f"{x} {y} {z}"])[0], place, image, xy))
    except OSError as error:
        raise OptionError(f"{path} cannot be read ({error.strerror}): check the path") from None
    except Exception as error:  # from pyproj, or text in place of numbers
        raise OptionError(
            f"{path} is not a file of ground control points ({first_line(error)}): write the "
            "coordinate system, such as EPSG:32633, then lines of x y z column row image"
        ) from None
    return rows


def georeference_by_control_points(
    sparse: SparseModel, control: Sequence[ControlRow], scale: float | None = None
) -> Georeference:
    """Find the place of a model by control points that are marked in two or more of its images."""
    seen = _seen_by_several(control, _by_file_name(sparse.images))
    points = {name: _triangulated(sparse, rows) for name, rows in seen.items()}
    places = np.array([next(iter(rows.values())).place for rows in seen.values()])
    up, level, stds = upright(sparse.views)
    known = {"up": up, "level": level, "level_stds": stds}
    return _place("ground control points", points, places, CONTROL_ACCURACY_M, scale, **known)


def _seen_by_several(
    control: Sequence[ControlRow], names: Mapping[str, str]
) -> dict[str, dict[str, ControlRow]]:
    """Return observations by point and image, of points in two or more of the named images."""
    seen: dict[str, dict[str, ControlRow]] = {}
    for row in control:
        if row.image in names:
            seen.setdefault(row.name, {})[names[row.image]] = row
    seen = {name: rows for name, rows in seen.items() if len(rows) > 1}
    if len(seen) < MIN_FIXES:
        raise OptionError(
            f"{len(seen)} ground control points are marked in two or more images of the model, "
            f"{MIN_FIXES} are needed: mark more, and name images by their files, with the folder "
            "if two files have the same name"
        )
    return seen


def _by_file_name(names: Iterable[str]) -> dict[str, str]:
    """Return the names of images, by themselves and by file names that only one image has."""
    names = [*names]
    counts = Counter(Path(name).name for name in names)
    alone = {Path(name).name: name for name in names if counts[Path(name).name] == 1}
    return {**alone, **{name: name for name in names}}


def _triangulated(sparse: SparseModel, rows: Mapping[str, ControlRow]) -> np.ndarray:
    """Return the point (3,) nearest to the lines of sight of the observations."""
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
    """Return the metres per unit of a model, from a known distance of two cameras or points.

    An end is the name of an image, for the position of its camera, or NAME:X,Y, for the one of the
    `points` (N, 3) at this pixel.
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
    # The nearest point to the camera hides others that are about as close to the pixel.
    near = np.flatnonzero(distances < distances.min() + 2)
    return np.asarray(points[near[depth[near].argmin()]], np.float64)


def _image_and_pixel(end: str, names: Mapping[str, str]) -> tuple[str, np.ndarray | None]:
    """Return the image that an end of a distance names, and the pixel, or None for a camera."""
    pixel = re.fullmatch(r"(.+):(\d+(?:\.\d+)?),(\d+(?:\.\d+)?)", end)
    name = pixel[1] if pixel else end
    if name not in names:
        raise OptionError(
            f"{name} is not an image of the model: name two of its images, or pixels as NAME:X,Y"
        )
    return names[name], np.array([float(pixel[2]), float(pixel[3])]) if pixel else None
