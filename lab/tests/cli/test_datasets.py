from __future__ import annotations

import json

import pytest


def test_list_names_size_and_licence(run) -> None:
    assert "19,336,861,798" in run("dev", "datasets", "list").output
    entries = {e["name"]: e for e in json.loads(run("dev", "datasets", "list", "--json").output)}
    names = {"coco", "photographs", "photographs-free", "oxford", "hpatches", "middlebury"}
    assert set(entries) == names
    assert entries["coco"]["images"] == 118_287
    assert entries["coco"]["bytes"] == 19_336_861_798


def test_get_reports_what_it_has_written(run, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fake(dataset, folder, quiet):
        from PIL import Image

        folder.mkdir(parents=True)
        Image.new("RGB", (16, 16)).save(folder / "a.png")
        return folder

    monkeypatch.setattr("deepdetect_lab.cli.datasets.get_dataset", fake)
    result = run("dev", "datasets", "get", "coco", "--json")
    assert json.loads(result.output)["images"] == 1
    assert (tmp_path / "data" / "coco" / "a.png").exists()


def test_an_unknown_name_ends_with_exit_code_2(run) -> None:
    result = run("dev", "datasets", "get", "kodak")
    assert result.exit_code == 2
