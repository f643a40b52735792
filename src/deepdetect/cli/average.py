"""`deepdetect average`: the mean of several weights."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import click

from ._options import PATH, check_inputs_survive, json_option, overwrite_option, print_result


@click.command(short_help="The mean of several weights.")
@click.argument("weights", nargs=-1, required=True, metavar="WEIGHTS...")
@click.option("-o", "--output", type=PATH, required=True, help="Folder for both files.")
@overwrite_option
@json_option
def average(weights: tuple[str, ...], output: Path, overwrite: bool, as_json: bool) -> None:
    """Average WEIGHTS (a model soup) into best.safetensors and deepdetect.onnx.

    The mean of runs that continue each other is often better than each of them; name one
    twice to give it twice the weight. WEIGHTS are .safetensors files, or default, dense or free.
    Files of another run are replaced with --overwrite only.

    \b
    deepdetect average first/best.safetensors second/best.safetensors -o mean
    deepdetect evaluate samples/ --weights mean/deepdetect.onnx
    """
    from .._shared.errors import (
        MissingExtraError,
        MissingWeightsError,
        OptionError,
        install_command,
    )

    for package in ("torch", "safetensors", "onnx"):
        if importlib.util.find_spec(package) is None:
            raise MissingExtraError(
                f"averaging weights needs the package {package}, which is not installed: "
                f"run {install_command('torch', 'safetensors', 'onnx')}"
            )
    from ..detector.pretrained import resolve_weights
    from ._records import claimed_outputs

    if len(weights) < 2:
        raise OptionError("give at least two weights: the mean of one is itself")
    paths = [resolve_weights(name, ".safetensors") for name in weights]
    for path in paths:  # before torch is imported, which takes a second
        if not path.exists():
            raise MissingWeightsError(f"there is no weights file {path}: check the path")

    files = {"weights": output / "best.safetensors", "onnx": output / "deepdetect.onnx"}
    check_inputs_survive(files.values(), paths, "choose another folder with -o")

    from .._shared.provenance import provenance
    from ..detector.network.onnx_export import export_onnx
    from ..detector.network.weights import (
        average_weights,
        load_network,
        read_notes,
        save_weights,
        weights_digest,
    )

    with claimed_outputs("average", paths, list(files.values()), overwrite):
        network = average_weights(paths)
        parts = [{"sha256": weights_digest(load_network(p)), **read_notes(p)} for p in paths]
        save_weights(network, files["weights"], {"parts": json.dumps(parts), **provenance()})
        export_onnx(network, files["onnx"])
    rows = [("mean of", f"{len(paths)} weights"), *((k, str(v)) for k, v in files.items())]
    print_result(as_json, files, rows)
