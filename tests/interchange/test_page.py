"""The commands and snippets of docs/other-programs.md, "Files", run in their order."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path

import pytest
from tests.command_line import run_section


@pytest.mark.slow
def test_the_page_runs(fountain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pycolmap", reason="needs pycolmap")
    from deepdetect.sfm.colmap import import_pycolmap

    pycolmap = import_pycolmap()
    shutil.copytree(fountain, tmp_path / "photos")
    names = sorted(path.name for path in fountain.iterdir())
    pairs = [" ".join(pair) for pair in itertools.combinations(names, 2)]
    (tmp_path / "pairs.txt").write_text("\n".join(pairs))
    (tmp_path / "sparse").mkdir()
    monkeypatch.chdir(tmp_path)
    assert run_section("other-programs.md", "Files") == 6
    assert pycolmap.Reconstruction("sparse/0").num_reg_images() == len(names)
    for name in ("database.db", "many.db"):
        with pycolmap.Database.open(name) as database:
            assert database.num_verified_image_pairs() == len(pairs), name
