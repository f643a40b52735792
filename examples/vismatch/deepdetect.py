"""A matcher for vismatch, to be saved as `vismatch/im_models/deepdetect.py`."""

from vismatch import BaseMatcher

from deepdetect import DeepDetect, PointDetector, match_images


class DeepDetectMatcher(BaseMatcher):
    """Guided matcher of two images, which runs on the CPU.

    The confidences are DeepDetect's scores. There are no descriptors, because guided matching
    compares patches.

    Args:
        device: device of the images.
        max_num_keypoints: number of keypoints, the best of all scales. None: dense keypoints.
        **kwargs: arguments of every matcher.
    """

    def __init__(self, device="cpu", max_num_keypoints=2048, **kwargs):
        super().__init__(device, **kwargs)
        dense = max_num_keypoints is None
        self.detector = DeepDetect() if dense else PointDetector(max_num_keypoints)

    def _forward(self, img0, img1):
        # Filters that scale images can exceed [0, 1] a little.
        found = match_images(img0.clamp(0, 1), img1.clamp(0, 1), self.detector)
        all0, all1 = found.keypoints0.xy, found.keypoints1.xy
        return found.points0, found.points1, all0, all1, None, None, found.scores
