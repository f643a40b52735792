"""The names of all commands."""

COMMANDS = {
    "Images": {
        "detect": "keypoints of images",
        "match": "matches between two images",
        "register": "one image registered to another",
        "stitch": "a panorama of overlapping images",
        "reconstruct": "a 3D reconstruction of two images, or of many",
    },
    "Many images": {
        "extract": "features of a collection of images",
        "match-many": "matches of many pairs of images",
        "track": "points followed through a video",
        "export": "files for other programs",
    },
    "DeepDetect itself": {
        "app": "a page in the browser, on this computer",
        "demo": "match a real stereo pair, and evaluate the matches",
        "doctor": "check the installation, and say what to do about it",
        "completion": "completion of commands and options by Tab",
    },
    "Development": {
        "datasets": "download data sets",
        "label": "training masks from nine classical detectors",
        "shards": "pack images for training on large sets",
        "train": "train the network on images",
        "train-points": "train the ranker of keypoints on images",
        "average": "the mean of several weights",
        "evaluate": "how good weights are",
        "evaluate-stereo": "correct stereo matches of weights and of label settings",
        "benchmark": "the tables and figures of the paper, with baselines",
    },
}
"""All commands by their group. Each is a function, or a group, in the module of its name, which is
imported when it is called."""
