"""Write a folder for model hubs for each set of weights: card, config, ONNX and safetensors.

    python tools/hub dist/hub

`DeepDetect.from_pretrained(folder)` reads the folders of networks. transformers also reads them
with `trust_remote_code`, by the code in modeling_deepdetect.py. Nothing is uploaded.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import shutil
from pathlib import Path
from typing import Any

from deepdetect import __version__
from deepdetect.detector.pretrained import FOLDER, POINTS_GRAPH, PRETRAINED, pretrained_weights

ROOT = Path(__file__).resolve().parents[2]
CARDS = {name: FOLDER / f"{name.upper()}_CARD.md" for name in PRETRAINED} | {
    "default": FOLDER / "MODEL_CARD.md"
}
DESCRIPTORS = ("descriptor", "descriptor_free")
FRONT_MATTER = """---
license: mit
library_name: deepdetect
pipeline_tag: keypoint-detection
tags: [keypoints, local-features, image-matching, onnx]
---

"""
MODELING = Path(__file__).with_name("modeling_deepdetect.py")
LAB = ROOT / "lab/src/deepdetect_lab"
TRANSFORMERS = {
    "model_type": "deepdetect",
    "architectures": ["DeepDetectForKeypointDetection"],
    "auto_map": {
        "AutoConfig": f"{MODELING.stem}.DeepDetectConfig",
        "AutoModel": f"{MODELING.stem}.DeepDetectForKeypointDetection",
        "AutoModelForKeypointDetection": f"{MODELING.stem}.DeepDetectForKeypointDetection",
    },
}
PREPROCESSOR = {
    "image_processor_type": "DeepDetectImageProcessor",
    "auto_map": {"AutoImageProcessor": f"{MODELING.stem}.DeepDetectImageProcessor"},
}


def write_folder(folder: Path, card: Path, files: dict[str, Path], config: dict[str, Any]) -> None:
    """Write the folder of a model, with absolute links in its card."""
    hook = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    assert hook is not None
    assert hook.loader is not None
    module = importlib.util.module_from_spec(hook)
    hook.loader.exec_module(module)
    folder.mkdir(parents=True)
    beside = card.parent.relative_to(ROOT)
    text = module.absolute_links(card.read_text("utf-8"), f"v{__version__}", str(beside))
    (folder / "README.md").write_text(FRONT_MATTER + text, "utf-8")
    _write_json(folder / "config.json", config)
    for name, path in files.items():
        shutil.copyfile(path, folder / name)


def add_transformers(folder: Path, name: str) -> None:
    """Add the code with which transformers loads a network."""
    file, network = ("espnet", "ESPNet") if name == "espnet" else ("fast", "FastNetwork")
    source = (LAB / f"networks/{file}.py").read_text("utf-8")
    (folder / "network.py").write_text(f"{source}\n\nNetwork = {network}\n", "utf-8")
    shutil.copyfile(MODELING, folder / MODELING.name)
    _write_json(folder / "preprocessor_config.json", PREPROCESSOR)


def _write_json(path: Path, values: dict[str, Any]) -> None:
    path.write_text(json.dumps(values, indent=1) + "\n", "utf-8")


def main() -> None:
    """Write all folders to a new folder."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("output", type=Path, help="a folder that does not exist")
    output = parser.parse_args().output
    about = {"library": "deepdetect", "version": __version__}
    for name, card in CARDS.items():
        files = {
            "deepdetect.onnx": pretrained_weights(name),
            "model.safetensors": LAB / f"weights/{name}.safetensors",
        }
        config: dict[str, Any] = {
            **about,
            **TRANSFORMERS,
            "kind": "network",
            "weights": name,
            "input": "RGB in [0, 1], (1, 3, H, W)",
        }
        write_folder(output / f"deepdetect-{name}", card, files, config)
        add_transformers(output / f"deepdetect-{name}", name)
    points = POINTS_GRAPH.parent
    files = {name: points / name for name in ("points.onnx", "ranker.npz")}
    write_folder(
        output / "deepdetect-points", points / "MODEL_CARD.md", files, about | {"kind": "points"}
    )
    files = {f"{name}.onnx": points / f"{name}.onnx" for name in DESCRIPTORS}
    config = about | {"kind": "descriptors", "dimensions": "64"}
    write_folder(output / "deepdetect-descriptors", points / "DESCRIPTOR_CARD.md", files, config)


if __name__ == "__main__":
    main()
