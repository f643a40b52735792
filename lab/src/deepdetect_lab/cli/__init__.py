"""The commands that this distribution adds to `deepdetect`, by entry points of its group."""

COMMANDS = {
    "Training": {
        "label": ("deepdetect_lab.cli.train", "training masks from nine classical detectors"),
        "train": ("deepdetect_lab.cli.train", "train the network on images"),
        "train-descriptor": (
            "deepdetect_lab.cli.train",
            "train the learned descriptor of keypoints on images",
        ),
    },
}
"""The commands by their group: the function's module, and what it does."""

DEVELOPMENT = {
    "Measuring": {
        "datasets": ("deepdetect_lab.cli.datasets", "download data sets"),
        "benchmark": (
            "deepdetect_lab.cli.evaluate",
            "the tables and figures of the paper, with baselines",
        ),
        "evaluate": ("deepdetect_lab.cli.evaluate", "how good weights are"),
        "compare-clouds": (
            "deepdetect_lab.cli.evaluate",
            "dense points compared with those of OpenMVS or COLMAP",
        ),
        "evaluate-stereo": (
            "deepdetect_lab.cli.evaluate",
            "correct stereo matches of weights and of label settings",
        ),
    },
    "Weights": {
        "shards": ("deepdetect_lab.cli.train", "pack images for training on large sets"),
        "train-points": ("deepdetect_lab.cli.train", "train the ranker of keypoints on images"),
        "train-match-filter": (
            "deepdetect_lab.cli.train",
            "train the network that tells right matches from wrong ones",
        ),
        "average": ("deepdetect_lab.cli.train", "the mean of several weights"),
    },
}
"""The commands after the word `dev`, in the same form."""
