"""Commands that this distribution adds to `deepdetect` by entry points."""

COMMANDS = {
    "Training": {
        "label": ("deepdetect_lab.cli.train", "Label images with nine classical detectors."),
        "train": ("deepdetect_lab.cli.train", "Train the network on images."),
        "train-descriptor": (
            "deepdetect_lab.cli.train",
            "Train the learned descriptor of keypoints on images.",
        ),
    },
}
"""Commands by group. Each command has the module of its function, and a summary."""

DEVELOPMENT = {
    "Measuring": {
        "datasets": ("deepdetect_lab.cli.datasets", "Download data sets."),
        "benchmark": (
            "deepdetect_lab.cli.evaluate",
            "Compute the paper's tables and figures, with other detectors for comparison.",
        ),
        "acceptance": (
            "deepdetect_lab.cli.evaluate",
            "Judge a matching engine on image pairs of many kinds.",
        ),
        "evaluate": ("deepdetect_lab.cli.evaluate", "Score weights on images with known masks."),
        "compare-clouds": (
            "deepdetect_lab.cli.evaluate",
            "Compare dense points with those of OpenMVS or COLMAP.",
        ),
        "evaluate-stereo": (
            "deepdetect_lab.cli.evaluate",
            "Compare weights and label settings by correct matches of stereo pairs.",
        ),
    },
    "Weights": {
        "read-teachers": (
            "deepdetect_lab.cli.train",
            "Compute published descriptors at points of photographs, to learn from them.",
        ),
        "train-points": ("deepdetect_lab.cli.train", "Train the ranker of keypoints on images."),
        "train-matcher": (
            "deepdetect_lab.cli.train",
            "Train the network that matches keypoints by attention.",
        ),
        "train-match-filter": (
            "deepdetect_lab.cli.train",
            "Train the network that separates correct matches from wrong ones.",
        ),
        "average": ("deepdetect_lab.cli.train", "Average several sets of weights into one."),
    },
}
"""Commands of `deepdetect dev`, in the same form as `COMMANDS`."""
