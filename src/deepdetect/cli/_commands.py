"""The names of all commands."""

NOTHING_FOUND = 3
"""Exit code where all went well and nothing was found."""

COMMANDS = {
    "Images": {
        "detect": ("detect", "keypoints of images"),
        "match": ("match", "matches between two images"),
        "register": ("match", "one image registered to another"),
        "stitch": ("match", "a panorama of overlapping images"),
        "reconstruct": ("reconstruct", "a 3D reconstruction of two images, or of many"),
    },
    "Many images": {
        "extract": ("features", "features of a collection of images"),
        "match-many": ("features", "matches of many pairs of images"),
        "track": ("track", "points followed through a video"),
        "export": ("export", "files for other programs"),
    },
    "DeepDetect itself": {
        "app": ("app", "a page in the browser, on this computer"),
        "demo": ("evaluate", "match a real stereo pair, and evaluate the matches"),
        "doctor": ("doctor", "check the installation, and say what to do about it"),
        "completion": ("_app", "completion of commands and options by Tab"),
    },
    "Development": {
        "datasets": ("datasets", "download data sets"),
        "label": ("train", "training masks from nine classical detectors"),
        "shards": ("train", "pack images for training on large sets"),
        "train": ("train", "train the network on images"),
        "train-points": ("train", "train the ranker of keypoints on images"),
        "average": ("train", "the mean of several weights"),
        "evaluate": ("evaluate", "how good weights are"),
        "evaluate-stereo": ("evaluate", "correct stereo matches of weights and of label settings"),
        "benchmark": ("evaluate", "the tables and figures of the paper, with baselines"),
    },
}
"""All commands by their group, with the module of the function or group, and what they do."""
