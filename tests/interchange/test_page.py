"""The commands and snippets of docs/other-programs.md, "Files", run in their order."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.command_line import run_command

PAGE = (Path(__file__).parents[2] / "docs/other-programs.md").read_text(encoding="utf-8")
PAGE = PAGE.partition("\n## Files\n")[2].partition("\n## ")[0]
BLOCKS = re.findall(r"^( *)```(sh|python)\n(.*?)^ *```", PAGE, re.S | re.M)


@pytest.mark.slow
def test_the_page_runs(fountain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pycolmap", reason="needs pycolmap")
    from deepdetect.sfm.colmap import import_pycolmap

    shutil.copytree(fountain, tmp_path / "photos")
    names = sorted(path.name for path in fountain.iterdir())
    pairs = [f"{a} {b}\n" for k, a in enumerate(names) for b in names[k + 1 :]]
    (tmp_path / "pairs.txt").write_text("".join(pairs))
    monkeypatch.chdir(tmp_path)
    done = 0
    for _, language, text in BLOCKS:
        if language == "python":
            if "from hloc import" in text and importlib.util.find_spec("hloc") is None:
                continue
            (tmp_path / "sparse").mkdir(exist_ok=True)
            ran = subprocess.run(
                [sys.executable, "-c", text], capture_output=True, text=True, env=os.environ
            )
            assert ran.returncode == 0, ran.stderr
            done += 1
            continue
        for line in text.replace("\\\n", " ").splitlines():
            words = shlex.split(line.partition("#")[0])
            if words[:1] != ["deepdetect"]:
                continue
            result = run_command(words[1:])
            assert result.exit_code == 0, f"{line}\n{result.output}"
            done += 1
    assert done >= 10
    pycolmap = import_pycolmap()
    assert pycolmap.Reconstruction("sparse/0").num_reg_images() == len(names)
    for name, count in (("database.db", 6), ("many.db", 6), ("few.db", 2)):
        with pycolmap.Database.open(name) as database:
            assert database.num_verified_image_pairs() == count, name
