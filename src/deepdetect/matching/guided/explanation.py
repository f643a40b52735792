"""Explain a pair of images: propose geometries, judge them, take the best, explain the rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..._shared.errors import ImageError
from ...features.keypoints import Keypoints, nearest_keypoints
from ...features.matches import MAX_KEYPOINT_DISTANCE_PX, GuidedMatches, TwoViewGeometry
from ...features.matches import Evidence as PublicEvidence
from ...features.matches import Layer as PublicLayer
from ...geometry.camera import Size
from ...geometry.estimation import log10_nfa, log10_nfa_nearby
from ...geometry.images import edge_strength
from ...geometry.lens import UNDISTORT, distortion
from ...geometry.transforms import outer_corners, transfer_errors
from ...geometry.two_view import GUIDING_THRESHOLDS_PX, fit_model, is_usual_rotation
from .along_plane import PlaneTracks, match_along_plane
from .along_rows import match_by_rectification
from .image_pair import ImagePair, Pair
from .judge import Evidence, Judge, contradicts
from .proposals import MIN_MATCHES, Hypothesis, Sources, Tentative, planes, propose

MIN_MATCHED_FRACTION = 0.02
"""Dense matching fails below this fraction of the smaller set of keypoints. Chosen by hand."""

MOST = 2 / 3
"""A scene has depth if a homography explains less than this fraction of the matches that agree with
a fundamental matrix. The confidence is "high" only if at least this fraction of all matches follows
the first geometry, because the other matches lie on objects that move differently."""

NEARLY_ALL = 0.9
"""A plane may be the whole scene if it fits MOST of the inliers of a fundamental matrix, or half of
them if it explains NEARLY_ALL of the compared cells: matches to a wrong period of a pattern also
lie on epipolar lines. Below NEARLY_ALL, objects before the plane are looked for."""

MAX_NEARBY_LOG10_NFA = -3.0
"""Sparse matches without dense ones suffice if the log10 NFA of their geometry is below
HIGH_LOG10_NFA, and that among nearby matches (`log10_nfa_nearby`) below this. Still matches do not
count: descriptors see frames and image borders. In 40 sparse answers of all test sets, wrong ones
have -2.3 or more among nearby matches; right ones with wide baselines have -4.3 or less."""

MIN_KEPT = 0.8
"""Depth also wins over a plane if it explains this fraction of the plane's cells both compare."""

OFF_RATIO = 4.0
"""A further geometry is fitted to matches this many inlier thresholds off all earlier ones."""

MIN_CHOSEN = 0.75
"""If this fraction of the tentative matches agrees with a plane, the plane is accepted although a
displaced copy fits as well, because descriptors tell the periods of the pattern apart. The fraction
is 0.45 to 0.9 on circuit boards, and up to 0.68 on 30 synthetic facades with identical windows."""

MIN_GAIN = 1.05
"""A plane moves on its own if it and a fundamental matrix F of the other matches fit MIN_GAIN times
as many matches as one matrix for all, and F fits under a third of the plane's. Chosen by hand."""

MAX_STILL = 0.005
"""An image stands still if its homography moves all image corners by less than this fraction of
the longer side. At 640 pixels, this is about the inlier threshold of a homography, 3 pixels."""

MIN_MOVING = 0.5
"""Geometries that stand still (a caption, a part of the vehicle) are left out if a moving one
explains this fraction of the windows of the largest one. Otherwise, the camera stands still."""

MAX_LAYERS = 4
"""Maximum number of geometries per pair: the scene and moving objects. Chosen by hand."""

HIGH_SHARE, HIGH_LOG10_NFA = 0.2, -12.0
"""Confidence is "high" only if HIGH_SHARE of the compared cells are explained and the log10 NFA is
below HIGH_LOG10_NFA. With no such limit, sparse matches answered one of 165 unrelated pairs."""

SCENE_MATCHES, DOMINANT_FRACTION = 1000, 0.5
"""A plane is dominant if at least DOMINANT_FRACTION of SCENE_MATCHES dense matches, which are drawn
at random, lie on it. It is then the largest part of the scene."""


NO_MATCHES = GuidedMatches(np.empty(0, np.int64), np.empty((0, 2)), np.empty(0, np.float32))


@dataclass(frozen=True, eq=False)
class Layer:
    """A geometry, its matches and evidence; `repeated` if a displaced copy of it fits as well."""

    hypothesis: Hypothesis
    matches: GuidedMatches
    evidence: Evidence
    tracks: PlaneTracks | None = None
    repeated: bool = False


class Explanation:
    """The geometries (layers) of a pair of images, first the one that explains most windows."""

    def __init__(
        self,
        pair: ImagePair,
        keypoints: tuple[Keypoints, Keypoints],
        asked: str = "auto",
        given: Pair | None = None,
        seed: int = 0,
    ) -> None:
        self._pair, self._asked, self._seed = pair, asked, seed
        self.pixels = np.rint(keypoints[0].xy), np.rint(keypoints[1].xy)
        self._sources = Sources(pair, given)
        self._judges: dict[bool, tuple[ImagePair, Judge]] = {}
        self.tried = Tentative(np.empty((0, 2)), np.empty((0, 2)))
        self.best_nfa = np.inf
        self.refuted = False
        self.left_out = 0.0

    @cached_property
    def layers(self) -> list[Layer]:
        """The layers, the one that explains most first; empty if no geometry can be trusted."""
        layers: list[Layer] = []
        fallback: Layer | None = None
        for tentative in self._sources:
            self.tried = tentative
            found = next(self._confirmed(tentative), None)
            if self.refuted:
                return []
            if found is None or (
                fallback is not None and found.hypothesis.log10_nfa > fallback.hypothesis.log10_nfa
            ):
                continue  # nothing is found, or an earlier source gave a better fallback
            if found.evidence.confirms:
                layers.append(found)
                break
            fallback = found
        if not layers:
            return [] if fallback is None else [fallback]
        explained = layers[0].evidence.explained
        if self._asked != "auto":
            return layers
        free = np.ones(len(tentative.points0), bool)
        while len(layers) < MAX_LAYERS:
            last = layers[-1].hypothesis
            errors = last.errors(tentative.points0, tentative.points1)
            free &= errors > OFF_RATIO * last.threshold_px
            further = next(self._confirmed(tentative.chosen(free), ~explained), None)
            if further is None or not further.evidence.confirms:
                break
            layers.append(further)
            explained = explained | further.evidence.explained
        layers.sort(key=lambda layer: -layer.evidence.windows)
        moving = [
            layer
            for layer in layers
            if layer.hypothesis.model != "homography"
            or not stands_still(layer.hypothesis.matrix, self._pair.sizes)
        ]
        least = MIN_MOVING * layers[0].evidence.windows
        if moving and moving[0].evidence.windows >= least:
            still = (each.evidence.explained.mean() for each in layers if each not in moving)
            self.left_out = float(sum(still))
            return moving
        return layers

    def _seen(self, cross_modal: bool) -> tuple[ImagePair, Judge]:
        if cross_modal not in self._judges:
            pair = self._pair
            if cross_modal:
                first, second = (edge_strength(gray) for gray in pair.grays)
                pair = ImagePair((first, second), pair.masks)
            self._judges[cross_modal] = pair, Judge(pair)
        return self._judges[cross_modal]

    def _confirmed(self, tentative: Tentative, free: np.ndarray | None = None) -> Iterator[Layer]:
        """Yield layers that the images confirm, best first, then one of sparse matches alone."""
        epipolar, (refuted, chance) = None, np.zeros((2, len(tentative.points0)), bool)
        surely, limit = False, np.inf if free is None else HIGH_LOG10_NFA
        if self._asked != "homography":
            epipolar = propose(self._pair, tentative, "fundamental", self._seed)
        sparse: list[Layer] = []
        flats: list[Hypothesis] = []
        if self._asked != "fundamental":
            flats = [*planes(self._pair, tentative, self._seed)]
        epipolar = None if epipolar is None or epipolar.log10_nfa >= limit else epipolar
        flats = [each for each in flats if each.log10_nfa < limit]
        flat: Layer | None = None
        tracks: PlaneTracks | None = None
        refuting: list[Layer] = []
        for plane in flats:
            layer = self._seen_plane(plane, epipolar, free)
            own, tracks = layer.hypothesis, layer.tracks
            self.best_nfa = min(self.best_nfa, own.log10_nfa)
            clear = free is None and _mostly(own.inliers, np.ones_like(own.inliers), MIN_CHOSEN)
            if layer.evidence.is_chance:
                chance |= own.inliers
            elif not layer.evidence.confirms:
                sparse.append(self._sparse(own) if layer.evidence.compares else layer)
            elif (layer.repeated and not clear) or any(_copies(layer, each) for each in refuting):
                refuting.append(layer)
                refuted |= own.inliers
                surely |= layer.evidence.share >= HIGH_SHARE
            else:
                flat = layer
                break
        if epipolar is not None and _mostly(chance, epipolar.inliers, 1 / 3):
            epipolar = None  # it fits matches whose planes explain no more than chance
        pattern = epipolar is not None and _mostly(refuted, epipolar.inliers, 1 / 2)
        part = None
        if epipolar is not None and flat is not None:
            least = 1 / 2 if flat.evidence.share >= NEARLY_ALL else MOST
            part = None if _mostly(flat.hypothesis.inliers, epipolar.inliers, least) else flat
        if epipolar is not None:
            epipolar = self._apart(flats, epipolar)
            self.best_nfa = min(self.best_nfa, epipolar.log10_nfa)
            if tracks is not None:
                epipolar = epipolar.refitted(self._pair, tracks.points)
        if flat is not None and len(flat.matches) < self._enough:
            flat = None
        if epipolar is not None:
            deep, best = None, part or flat
            foreground = flat is not None and flat.evidence.share < NEARLY_ALL
            tried = part or (flat is None and not pattern)
            if tried or (tracks and tracks.show_depth(foreground, self._seed)):
                deep = self._along_rows(epipolar, best, free)
            if deep and any(_copies(deep, each) for each in refuting):
                deep, pattern = None, True
            if deep and (best is None or _wins(deep, best)):
                yield deep
            elif not pattern:
                sparse.append(self._sparse(epipolar))
        if flat is not None and (part is None or pattern):
            yield flat
        nothing = free is None and flat is None and (epipolar is None or pattern)
        self.refuted = nothing and surely
        sparse = [each for each in sparse if self._suffices(each)]
        if sparse and free is None and not (nothing and refuted.any()):
            yield min(sparse, key=lambda each: each.hypothesis.log10_nfa)

    def _seen_plane(
        self, plane: Hypothesis, epipolar: Hypothesis | None, free: np.ndarray | None
    ) -> Layer:
        """Refine the homography of a plane by tracks; return the layer of what it explains."""
        pair, judge = self._seen(plane.tentative.cross_modal)
        agreeing = plane.inliers if epipolar is None else plane.inliers | epipolar.inliers
        some = plane.tentative.chosen(agreeing)
        tracks = PlaneTracks(pair, plane.matrix, (some.points0, some.points1), free)
        view = judge.along_plane(tracks.homography)
        evidence = self._on_free(view.evidence, free)
        exact, matches = replace(plane, matrix=tracks.homography), NO_MATCHES
        if evidence.confirms or not evidence.compares:
            matches = match_along_plane(pair, self.pixels, exact.matrix, judge, evidence)
        return Layer(exact, matches, evidence, tracks, evidence.confirms and view.repeated)

    def _apart(self, flats: Sequence[Hypothesis], epipolar: Hypothesis) -> Hypothesis:
        """Return the matrix of the matches off a plane that moves on its own; else `epipolar`."""
        for plane in flats:
            tentative = plane.tentative
            off = plane.errors(tentative.points0, tentative.points1) > 2 * plane.threshold_px
            rest = propose(self._pair, tentative.chosen(off), "fundamental", self._seed)
            if rest is None or 3 * np.count_nonzero(rest.inliers) < np.count_nonzero(plane.inliers):
                continue  # few matches, as on a post before a wall, fit many matrices
            inliers = np.zeros(len(off), bool)
            inliers[np.flatnonzero(off)[rest.inliers]] = True
            along = rest.errors(*plane.points) < 2 * rest.threshold_px
            gain = _mostly(inliers | plane.inliers, epipolar.inliers, MIN_GAIN)
            if gain and np.mean(along) < 1 / 3:
                return replace(rest, inliers=inliers, tentative=tentative)
        return epipolar

    def _along_rows(
        self, epipolar: Hypothesis, plane: Layer | None, free: np.ndarray | None
    ) -> Layer | None:
        """Match along epipolar lines, perhaps after a warp by `plane`; None if rejected."""
        pair, judge = self._seen(epipolar.tentative.cross_modal)
        count, lattice = len(self.pixels[0]), judge.lattice()
        everywhere = np.concatenate([self.pixels[0], lattice])
        known = None if plane is None else plane.hypothesis.matrix
        found = match_by_rectification(
            pair.grays, everywhere, epipolar.points, epipolar.matrix, plane=known
        )
        if found is None or np.count_nonzero(found[1].indices0 < count) < self._enough:
            return None
        matrix, both = found
        own = both.indices0 < count
        matches = both.chosen(own)
        starts = matches.starts(self.pixels[0])
        # Matches of a regular lattice are judged, so that the positions of keypoints do not matter.
        view = judge.along_matches(everywhere[both.indices0[~own]], both.points1[~own])
        evidence = self._on_free(view.evidence, free)
        if not evidence.confirms or view.repeated:
            return None
        if free is not None:
            matches = matches.chosen(evidence.explained[judge.cells_of(starts)])
        return Layer(replace(epipolar, matrix=matrix), matches, evidence)

    def _sparse(self, hypothesis: Hypothesis) -> Layer:
        points0, points1 = hypothesis.points
        rows, distances = nearest_keypoints(points0, self.pixels[0], self._pair.sizes[0])
        rows = np.where(distances <= MAX_KEYPOINT_DISTANCE_PX, rows, -1).astype(np.int64)
        scores = np.ones(len(rows), np.float32)
        matches = GuidedMatches(rows, points1, scores, subpixel=True, points0=points0)
        nowhere = np.zeros((1, 1), bool)
        nothing = Evidence(np.full((1, 1), np.nan), 1.0, 1.0, nowhere, nowhere)
        return Layer(hypothesis, matches, nothing)

    def _suffices(self, layer: Layer) -> bool:
        """Return whether the sparse matches of a layer suffice (see `MAX_NEARBY_LOG10_NFA`)."""
        hypothesis = layer.hypothesis
        sizes, tentative = self._pair.sizes, hypothesis.tentative
        motion = np.linalg.norm(tentative.points1 - tentative.points0, axis=1)
        still_px = GUIDING_THRESHOLDS_PX["homography"] * tentative.pixel
        moving = motion >= (still_px if sizes[0] == sizes[1] else 0)
        model, threshold_px = hypothesis.model, hypothesis.threshold_px
        alarms = log10_nfa(hypothesis.inliers[moving], model, threshold_px, sizes[1])
        if alarms >= HIGH_LOG10_NFA or len(layer.matches) < MIN_MATCHES:
            return False
        errors = hypothesis.errors(tentative.points0[moving], tentative.points1[moving])
        return log10_nfa_nearby(errors, model, threshold_px) < MAX_NEARBY_LOG10_NFA

    def _on_free(self, evidence: Evidence, free: np.ndarray | None) -> Evidence:
        if free is None:
            return evidence
        return replace(evidence, similarity=np.where(free, evidence.similarity, np.nan))

    @cached_property
    def _enough(self) -> float:
        return max(MIN_MATCHED_FRACTION * min(len(xy) for xy in self.pixels), MIN_MATCHES)

    def answer(self) -> tuple[TwoViewGeometry, GuidedMatches | None]:
        """Return the geometry of the first layer, and the matches of all layers."""
        tried = len(self.tried.points0)
        if not self.layers:
            evidence = PublicEvidence(tried, 0, self.best_nfa, self.tried.views)
            return TwoViewGeometry("none", evidence=evidence), None
        first = self.layers[0]
        own = first.hypothesis
        planes_move = own.model == "homography" and len(self.layers) > 1  # planes can mimic a lens
        if self._asked != "homography" and not planes_move:
            straight_lines(self._pair, own)
        matches = first.matches
        for layer in self.layers[1:]:
            new = ~np.isin(layer.matches.indices0, matches.indices0)
            matches = matches.joined(layer.matches, new)
        number = np.zeros(len(matches), np.int8)
        for k, layer in reversed([*enumerate(self.layers)]):
            number[np.isin(matches.indices0, layer.matches.indices0)] = k
        starts = matches.starts(self.pixels[0])
        alike = np.ones(len(matches), bool)
        if first.evidence.confirms and own.model == "fundamental":
            _, judge = self._seen(own.tentative.cross_modal)
            cells = judge.cells_of(starts)
            alike = ~first.evidence.contradicted[cells]
            for layer in self.layers[1:]:
                alike |= layer.evidence.explained[cells]
        high = len(first.matches) >= MOST * len(matches) and self._is_sure(first)
        evidence = PublicEvidence(
            len(own.tentative.points0),
            int(np.count_nonzero(own.inliers)),
            float(own.log10_nfa),
            own.tentative.views,
            verified=first.evidence.share,
            agreement=first.evidence.agreement,
            correlation=first.evidence.correlation,
            left_out=self.left_out,
        )
        each = ((layer.hypothesis, layer.evidence.share) for layer in self.layers)
        layers = (PublicLayer(found.model, found.matrix, share) for found, share in each)
        geometry = TwoViewGeometry(
            own.model, own.matrix, "none", "high" if high else "fair", evidence, tuple(layers)
        )
        geometry = self._with_scene(geometry, starts, matches.points1)
        return geometry, replace(matches, alike=alike, layer=number)

    def _is_sure(self, layer: Layer) -> bool:
        """Return whether the images and the sparse matches leave no doubt about the first layer."""
        own, seen = layer.hypothesis, layer.evidence
        least = HIGH_SHARE if len(self.layers) == 1 else MOST
        unlike = contradicts(seen)
        if self._stands_still(layer.matches):
            still = self._seen(own.tentative.cross_modal)[1].along_plane(np.eye(3)).evidence
            # If some of the image moves, the still part may be an overlay.
            unlike |= still.agreement < NEARLY_ALL or still.share < NEARLY_ALL * seen.share
        strong = seen.share >= least and own.log10_nfa < HIGH_LOG10_NFA
        before = layer.tracks is not None and layer.tracks.show_depth(True, self._seed)
        return seen.confirms and strong and not (layer.repeated or unlike or before)

    def _stands_still(self, matches: GuidedMatches) -> bool:
        """Return whether half of the matches of equal-sized images move less than `MAX_STILL`."""
        first, second = self._pair.sizes
        motion = np.linalg.norm(matches.points1 - matches.starts(self.pixels[0]), axis=1)
        return first == second and bool(np.median(motion) < MAX_STILL * max(first))

    def _with_scene(
        self, geometry: TwoViewGeometry, points0: np.ndarray, points1: np.ndarray
    ) -> TwoViewGeometry:
        some = np.random.default_rng(self._seed).permutation(len(points0))[:SCENE_MATCHES]
        ends = points0[some].astype(np.float64), points1[some]
        if geometry.model == "homography":
            scene = "rotation" if is_usual_rotation(*ends, self._pair.sizes) else "planar"
            assert geometry.matrix is not None
            if stands_still(geometry.matrix, self._pair.sizes):
                scene = "still"
            evidence = replace(geometry.evidence, on_plane=len(points0))
            return replace(geometry, scene=scene, evidence=evidence)
        plane = fit_model(
            *ends,
            "homography",
            self._pair.sizes[1],
            GUIDING_THRESHOLDS_PX["homography"],
            self._seed,
        )
        if plane.matrix is None or np.mean(plane.inliers) < DOMINANT_FRACTION:
            return replace(geometry, scene="depth")
        off = (
            transfer_errors(points0, points1, plane.matrix)
            > 2 * GUIDING_THRESHOLDS_PX["homography"]
        )
        count = int(np.count_nonzero(off))
        evidence = replace(geometry.evidence, on_plane=len(points0) - count, off_plane=count)
        return replace(geometry, scene="depth with a dominant plane", evidence=evidence)


def stands_still(homography: np.ndarray, sizes: tuple[Size, Size]) -> bool:
    """Return whether a homography moves no corner of equal-sized images by `MAX_STILL`."""
    corners = outer_corners(sizes[0])
    motion = transfer_errors(corners, corners, homography)
    return sizes[0] == sizes[1] and bool(motion.max() < MAX_STILL * max(sizes[0]))


def straight_lines(pair: ImagePair, hypothesis: Hypothesis) -> None:
    """Raise an ImageError if a lens that bends lines fits the matches better than a pinhole."""
    ends = hypothesis.tentative.points0, hypothesis.tentative.points1
    if distortion(*ends, hypothesis.inliers, pair.sizes):
        raise ImageError(
            "the lens of both images bends straight lines, as that of a fisheye, which no "
            f"pinhole geometry fits: {UNDISTORT}"
        )


def _copies(plane: Layer, other: Layer) -> bool:
    """Return whether half of a plane's cells are also another's that explains no fewer windows."""
    both = plane.evidence.explained & other.evidence.explained
    least = np.count_nonzero(plane.evidence.explained) / 2
    fewer = plane.evidence.windows <= other.evidence.windows
    return bool(fewer and np.count_nonzero(both) >= least)


def _wins(deep: Layer, plane: Layer) -> bool:
    """Return whether `deep` has half of `plane`'s windows, or explains `MIN_KEPT` of its cells."""
    compared = plane.evidence.explained & np.isfinite(deep.evidence.similarity)
    kept = compared.any() and _mostly(compared & deep.evidence.explained, compared, MIN_KEPT)
    return bool(kept) or deep.evidence.windows >= plane.evidence.windows / 2


def _mostly(some: np.ndarray, inliers: np.ndarray, least: float = MOST) -> bool:
    """Return whether the number of `some` is at least `least` times the number of `inliers`."""
    return bool(np.count_nonzero(some) >= least * np.count_nonzero(inliers))
