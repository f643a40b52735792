#!/usr/bin/env bash
# OpenVINO's CPU plugin leaves a thread with a signal stack that is already freed, if cores end first in, first out.
#
# The first model that a `Core` compiles for the CPU registers an alternate signal stack for the calling thread
# (sigaltstack), whether or not the processor needs one, and the end of the core restores the one that was there before.
# Two cores that end in the order in which they were made therefore leave the stack of the first one, which is unmapped
# by then. CPython installs all its handlers with SA_ONSTACK, so that a later signal, such as Ctrl-C or the end of a
# data loader's process, ended our process instead of raising KeyboardInterrupt. With one core for all models, or cores
# that end last in, first out, the stack is valid. This script only reads the state. Linux, x86-64. Run by hand; exits
# with 1 where the behaviour is another.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check numpy==2.4.6 openvino==2026.4.1
"$folder/venv/bin/python" - <<'PYTHON'
import ctypes
import gc
import sys

import numpy as np
import openvino
from openvino import opset13

SS_DISABLE = 2


class Stack(ctypes.Structure):
    _fields_ = [("address", ctypes.c_void_p), ("flags", ctypes.c_int), ("size", ctypes.c_size_t)]


def signal_stack():
    """Describe the alternate signal stack of this thread: none, valid, or unmapped."""
    found = Stack()
    ctypes.CDLL(None).sigaltstack(None, ctypes.byref(found))
    if found.flags & SS_DISABLE:
        return "none"
    for line in open("/proc/self/maps"):
        first, last = (int(end, 16) for end in line.split()[0].split("-"))
        if first <= found.address < last:
            return "valid"
    return "unmapped"


def compiled():
    x = opset13.parameter([1, 3, 8, 8], np.float32)
    return openvino.Core().compile_model(openvino.Model([opset13.relu(x)], [x], "relu"), "CPU")


seen = {"before": signal_stack()}
first = compiled()
seen["one core"] = signal_stack()
second = compiled()
del second
gc.collect()
seen["the second of two has ended"] = signal_stack()
second = compiled()
del first
gc.collect()
del second
gc.collect()
seen["the first, then the second has ended"] = signal_stack()
print(f"openvino {openvino.__version__}, the thread's alternate signal stack:")
for when, state in seen.items():
    print(f"  {when}: {state}")
if list(seen.values()) != ["none", "valid", "valid", "unmapped"]:
    sys.exit("the behaviour has changed")
PYTHON
