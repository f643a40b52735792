import subprocess
import sys

import pytest

pytest.importorskip("openvino")

INTERRUPTED = """
import gc, signal
import numpy as np
from deepdetect import OptionError
from deepdetect.detector.backends.interface import RuntimeOptions
from deepdetect.detector.backends.openvino_backend import open_openvino
from deepdetect.detector.pretrained import resolve_weights
path = resolve_weights("default")
first, second = (open_openvino(path.read_bytes(), RuntimeOptions()) for _ in range(2))
try:
    open_openvino(path.read_bytes(), RuntimeOptions(device="tpu"))
except OptionError:
    pass
second.run(["logits"], {"image": np.zeros((1, 3, 32, 32), np.float32)})
del first
gc.collect()
del second
gc.collect()
try:
    signal.raise_signal(signal.SIGINT)
except KeyboardInterrupt:
    print("interrupted")
"""


def test_ctrl_c_is_handled_after_models_have_ended() -> None:
    done = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "interrupted\n"), done.stderr
