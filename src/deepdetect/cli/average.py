"""`deepdetect average`: the mean of several weights."""

from __future__ import annotations

import json
from typing import Annotated

from cyclopts import Parameter

from .._shared.errors import MissingWeightsError, OptionError
from .._shared.provenance import provenance
from .._shared.records import Outputs
from ..detector.pretrained import resolve_weights
from ..training.run import require_packages
from . import _options as cli


def average(
    weights: Annotated[
        list[str],
        Parameter(help=".safetensors files, or default, dense or free; one twice counts double."),
    ],
    /,
    *,
    output: cli.Output,
    overwrite: cli.Overwrite = False,
    as_json: cli.Json = False,
) -> None:
    """Average weights (a model soup) into best.safetensors and deepdetect.onnx.

    The mean of runs that continue each other is often better than each of them. Files of another
    run are replaced with --overwrite only.

        deepdetect average first/best.safetensors second/best.safetensors -o mean
        deepdetect evaluate samples/ --weights mean/deepdetect.onnx

    Args:
        output: Folder for both files.
    """
    require_packages()
    if len(weights) < 2:
        raise OptionError("give at least two weights: the mean of one is itself")
    paths = [resolve_weights(name, ".safetensors") for name in weights]
    for path in paths:  # before torch is imported, which takes a second
        if not path.exists():
            raise MissingWeightsError(f"there is no weights file {path}: check the path")
    folder = cli.output_folder(output)
    files = {"weights": folder / "best.safetensors", "onnx": folder / "deepdetect.onnx"}
    cli.check_inputs_survive(files.values(), paths)

    from ..detector.network.onnx_export import export_onnx
    from ..detector.network.weights import (
        average_weights,
        load_network,
        read_notes,
        save_weights,
        weights_digest,
    )

    with (
        cli.writing(Outputs([*files.values()], paths, overwrite=overwrite)),
        cli.whole(files) as made,
    ):
        network = average_weights(paths)
        parts = [{"sha256": weights_digest(load_network(p)), **read_notes(p)} for p in paths]
        save_weights(network, made["weights"], {"parts": json.dumps(parts), **provenance()})
        export_onnx(network, made["onnx"])
    cli.print_result(as_json, files)
