"""`deepdetect export onnx`: the network for other runtimes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import click

from ._generated import FieldOptions, generated_command, given_only
from ._options import PATH, check_inputs_survive, json_option, print_result


class Size(click.ParamType):  # type: ignore[type-arg]  # generic in new versions only
    """Height and width as HxW."""

    name = "HxW"

    def convert(self, value: Any, param: Any, context: Any) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})", value)
        if match is None:
            self.fail(f"{value!r} is no height and width, as 480x640", param, context)
        return int(match[1]), int(match[2])


OPTIONS = FieldOptions(
    "detector.network.onnx_variants:OnnxOptions",
    types={"size": Size()},
    defaults={"size": "any"},
)


@generated_command(OPTIONS, name="onnx", short_help="The network for other runtimes.")
@click.argument("weights", default="default", metavar="[WEIGHTS]")
@click.option("-o", "--output", type=PATH, required=True, help="The .onnx file to be written.")
@click.option(
    "--calibration",
    type=PATH,
    multiple=True,
    metavar="IMAGE|FOLDER",
    help="Photographs for int8, like those that it will be used on.",
)
@click.option("--licence", help="What the file says of the licence of the weights.")
@json_option
def export_onnx(
    weights: str,
    output: Path,
    calibration: tuple[Path, ...],
    licence: str | None,
    as_json: bool,
    **values: Any,
) -> None:
    """Write WEIGHTS as an ONNX file, for ONNX Runtime, OpenVINO, OpenCV and others.

    WEIGHTS are default, dense, free, an ONNX file that this package has written in fp32 for any
    size, or a .safetensors file, which needs torch. Input `image`: RGB from 0 to 1; outputs
    `probability` and `logits` for each pixel, and the best `keypoints` with `keypoint_logits`.
    docs/other-programs.md says which file is for which runtime.

    \b
    deepdetect export onnx -o deepdetect.onnx
    deepdetect export onnx dense -o dense-480x640.onnx --size 480x640 --max-keypoints 0
    deepdetect export onnx run/best.safetensors -o half.onnx --precision fp16
    deepdetect export onnx -o maps.onnx --max-keypoints 0
    deepdetect export onnx -o small.onnx --precision int8 --calibration photos/
    """
    from ..detector.network.onnx_variants import OnnxOptions, write_onnx
    from ..detector.pretrained import resolve_weights
    from ..io.image import find_images

    options = OnnxOptions(**given_only(values))
    images = [
        image for path in calibration for image in (find_images(path) if path.is_dir() else [path])
    ]
    inputs = [resolve_weights(weights), *images]
    check_inputs_survive([output], inputs, "choose another name with -o")
    metadata = write_onnx(weights, output, options, calibration=images, licence=licence)
    size = output.stat().st_size
    print_result(
        as_json,
        {"file": output, "bytes": size, "metadata": metadata},
        [("written", f"{output}, {size / 1e6:.2f} MB"), *metadata.items()],
    )
