from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from fuzz import campaign
from fuzz.campaign import run_batch, run_campaign
from fuzz.case import Target
from fuzz.mutations import mutate
from fuzz.targets import TARGETS

# Says of each input what its number asks for.
CHILD = """
import json, os, sys, time
first, last = int(sys.argv[3]), int(sys.argv[4])
for number in range(first, last):
    print(json.dumps({"begins": number}), flush=True)
    if number == 2:
        os.kill(os.getpid(), 11)
    if number == 4:
        time.sleep(60)
    print(json.dumps({"ends": number, "outcome": "right", "reason": ""}), flush=True)
    if number == 6:
        os._exit(0)
"""
FAKE = Target("fake", "nothing", lambda generator, folder: None, 8, 8, limit_s=1.0)


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "child.py"
    script.write_text(CHILD)
    monkeypatch.setattr(campaign, "CHILD", (sys.executable, str(script)))


def test_the_input_that_ends_a_process_is_named_and_the_rest_go_on(fake: None) -> None:
    found = {number: outcome for number, outcome, _ in run_batch(FAKE, 0, 0, 8)}
    assert found.pop(2) == "crash"
    assert found.pop(4) == "hang"
    assert found.pop(7) == "crash"  # the process was gone before it
    assert found == dict.fromkeys((0, 1, 3, 5, 6), "right")


def test_mutations_depend_on_the_seed_alone() -> None:
    content = bytes(range(200))
    first = [mutate(content, np.random.default_rng([0, k])) for k in range(50)]
    again = [mutate(content, np.random.default_rng([0, k])) for k in range(50)]
    assert first == again
    assert len(set(first)) > 40
    assert any(one == content for one in first)


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_a_few_inputs_of_each_target(name: str) -> None:
    found = run_campaign([TARGETS[name]], seed=1, share=20 / TARGETS[name].count, processes=1)
    assert found[name].tried == 20
    assert not found[name].defects
