from __future__ import annotations

import shutil
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from deepdetect import OptionError
from deepdetect.cli._records import OutputRecords, claim_outputs, claimed_outputs
from tests.cli.conftest import one_sentence


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "photo.jpg"
    path.write_bytes(b"pixels")
    return path


def test_another_process_may_do_the_same_at_the_same_time(tmp_path: Path, source: Path) -> None:
    out = tmp_path / "out"
    outputs = [out / "photo.npz", out / "photo.png"]
    one, other = (OutputRecords("detect", out, {"threshold": 0.5}) for _ in range(2))
    assert one.find(source, outputs) is None
    one.begin(source, outputs)
    outputs[0].write_bytes(b"half of the work")
    assert other.find(source, outputs) is None, "it is being made, or was when it was killed"
    outputs[1].write_bytes(b"the other half")
    one.finish(source, outputs, {"keypoints": 3})
    assert other.find(source, outputs) == {"keypoints": 3}
    different = OutputRecords("detect", out, {"threshold": 0.6})
    assert different.find(source, outputs) is None
    assert different.changed == {source: ["threshold"]}
    assert OutputRecords("detect", out, {}, overwrite=True).find(source, outputs) is None


def test_commands_do_not_know_each_other_s_outputs(tmp_path: Path, source: Path) -> None:
    outputs = [tmp_path / "out" / "photo.png"]
    records = OutputRecords("detect", tmp_path / "out", {})
    records.begin(source, outputs)
    outputs[0].write_bytes(b"picture")
    records.finish(source, outputs, {})
    with pytest.raises(OptionError, match="is not known to be of"):
        OutputRecords("another", tmp_path / "out", {}).find(source, outputs)


def test_a_lost_output_is_made_again(tmp_path: Path, source: Path) -> None:
    outputs = [tmp_path / "out" / name for name in ("photo.npz", "photo.png")]
    records = OutputRecords("detect", tmp_path / "out", {})
    records.begin(source, outputs)
    for path in outputs:
        path.write_bytes(b"whole")
    records.finish(source, outputs, {"keypoints": 3})
    outputs[1].unlink()
    assert records.find(source, outputs) is None
    assert records.find(source, outputs[:1]) == {"keypoints": 3}


def test_each_output_belongs_to_the_files_that_it_was_made_from(tmp_path: Path) -> None:
    first, second = [tmp_path / "a.png"], [tmp_path / "b.png"]
    jpeg, png = tmp_path / "out" / "pan.jpg", tmp_path / "out" / "pan.png"
    claim_outputs("stitch", first, [jpeg], overwrite=False)
    jpeg.write_bytes(b"of a")
    claim_outputs("stitch", second, [png], overwrite=False)
    png.write_bytes(b"of b")
    for inputs, outputs in ((second, [jpeg]), (first, [png]), (second, [png, jpeg])):
        with pytest.raises(OptionError, match="made from"):
            claim_outputs("stitch", inputs, outputs, overwrite=False)
    claim_outputs("stitch", first, [jpeg], overwrite=False)
    claim_outputs("stitch", second, [jpeg], overwrite=True)


def test_what_nobody_claimed_is_not_replaced(tmp_path: Path) -> None:
    inputs = [tmp_path / "a.png"]
    outputs = [tmp_path / "m.npz", tmp_path / "m.jpg"]
    claim_outputs("match", inputs, outputs[:1], overwrite=False)
    for path in outputs:
        path.write_bytes(b"the picture is somebody's own")
    with pytest.raises(OptionError, match=r"m\.jpg exists already, and is not known"):
        claim_outputs("match", inputs, outputs, overwrite=False)


def test_a_growing_list_of_inputs_keeps_its_outputs(tmp_path: Path) -> None:
    photographs = [tmp_path / f"{name}.jpg" for name in "abc"]
    model = tmp_path / "model.ply"
    claim_outputs("reconstruct", photographs[:2], [model], overwrite=False, growing=True)
    model.write_text("")
    with pytest.raises(OptionError, match=r"model\.ply exists already, made from .*a\.jpg"):
        claim_outputs("reconstruct", photographs, [model], overwrite=False)
    claim_outputs("reconstruct", photographs, [model], overwrite=False, growing=True)
    with pytest.raises(OptionError, match=r"made from .*c\.jpg: choose another folder"):
        claim_outputs("reconstruct", photographs[1:], [model], overwrite=False, growing=True)
    claim_outputs("reconstruct", photographs[1:], [model], overwrite=True, growing=True)
    claim_outputs("reconstruct", photographs[1:], [model], overwrite=False)


def test_work_that_fails_leaves_no_trace(tmp_path: Path) -> None:
    output = tmp_path / "new" / "folder" / "m.npz"

    def work(error: type[BaseException]) -> None:
        with claimed_outputs("match", [tmp_path / "a.png"], [output], overwrite=False):
            assert list(tmp_path.rglob("*.json")), "it is claimed before the work"
            raise error

    for error in (RuntimeError, KeyboardInterrupt):
        with pytest.raises(error):
            work(error)
        assert not list(tmp_path.iterdir())


def test_records_of_others_stay_when_work_fails(tmp_path: Path) -> None:
    inputs = [tmp_path / "a.png"]
    claim_outputs("match", inputs, [tmp_path / "other.npz"], overwrite=False)
    with pytest.raises(RuntimeError), claimed_outputs("match", inputs, [tmp_path / "m.npz"], False):
        raise RuntimeError
    assert [path.name for path in tmp_path.rglob("*.json")] == ["other.npz.json"]


def test_what_is_not_replaced_is_still_known_to_be_of_its_files(tmp_path: Path) -> None:
    first, second = [tmp_path / "a.png"], [tmp_path / "b.png"]
    outputs = [tmp_path / "m.npz", tmp_path / "m.jpg"]
    with claimed_outputs("match", first, outputs, overwrite=False):
        for path in outputs:
            path.write_bytes(b"of a")

    def work() -> None:
        with claimed_outputs("match", second, outputs, overwrite=True):
            outputs[0].write_bytes(b"whole, and of b")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        work()
    claim_outputs("match", second, outputs[:1], overwrite=False)
    with pytest.raises(OptionError, match=r"m\.jpg exists already, made from .*a\.png"):
        claim_outputs("match", second, outputs[1:], overwrite=False)
    claim_outputs("match", first, outputs[1:], overwrite=False)


def test_a_signal_that_ends_the_process_leaves_no_trace(tmp_path: Path) -> None:
    usual = signal.getsignal(signal.SIGTERM)
    assert usual is signal.SIG_DFL

    def work() -> None:
        with claimed_outputs("match", [tmp_path / "a.png"], [tmp_path / "new" / "m.npz"], False):
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(SystemExit) as ended:
        work()
    assert ended.value.code == 128 + signal.SIGTERM
    assert not list(tmp_path.iterdir())
    assert signal.getsignal(signal.SIGTERM) is usual


def test_work_in_another_thread_has_no_signals(tmp_path: Path) -> None:
    def work() -> None:
        with claimed_outputs("match", [tmp_path / "a.png"], [tmp_path / "m.npz"], False):
            (tmp_path / "m.npz").touch()

    with ThreadPoolExecutor(1) as pool:
        pool.submit(work).result()
    claim_outputs("match", [tmp_path / "a.png"], [tmp_path / "m.npz"], overwrite=False)


@pytest.mark.parametrize("other_name", ["a.png", "b.png"])
@pytest.mark.parametrize("fails_first", [True, False])
def test_a_failure_takes_no_record_from_a_command_at_work(
    other_name: str, fails_first: bool, tmp_path: Path
) -> None:
    """Whether the other command works on the same files or not; either may begin and end first."""
    inputs, others, output = [tmp_path / "a.png"], [tmp_path / other_name], tmp_path / "m.npz"
    other = claimed_outputs("match", others, [output], overwrite=True)
    failing = claimed_outputs("match", inputs, [output], overwrite=True)

    def fail() -> None:
        failing.__exit__(RuntimeError, RuntimeError(), None)

    def succeed() -> None:
        output.write_bytes(b"whole")
        other.__exit__(None, None, None)

    both = [(failing, fail), (other, succeed)]
    for context, _ in both if fails_first else reversed(both):
        context.__enter__()
    for _, end in both if fails_first else reversed(both):
        end()
    claim_outputs("match", others, [output], overwrite=False)


def test_an_output_belongs_to_the_command_that_wrote_it_last(tmp_path: Path) -> None:
    first, second, output = [tmp_path / "a.png"], [tmp_path / "b.png"], tmp_path / "m.npz"
    with claimed_outputs("match", first, [output], overwrite=False):
        with claimed_outputs("match", second, [output], overwrite=False):
            output.write_bytes(b"of b")
        output.write_bytes(b"of a")
    claim_outputs("match", first, [output], overwrite=False)
    with pytest.raises(OptionError, match=r"made from .*a\.png"):
        claim_outputs("match", second, [output], overwrite=False)


@pytest.mark.parametrize(
    ("command", "package"),
    [
        (("extract", "photos", "-o", "out.h5"), "h5py"),
        (("export", "colmap", "photos", "-o", "out"), "h5py"),
        (("shards", "photos", "-o", "out"), "torch"),
        (("train", "photos", "-o", "out"), "torch"),
        (("train-points", "photos", "--validation", "photos", "-o", "out"), "torch"),
    ],
)
def test_pictures_of_earlier_runs_are_no_photographs(
    run, photos: Path, tmp_path: Path, command: tuple[str, ...], package: str
) -> None:
    pytest.importorskip(package, reason=f"needs {package}")
    shutil.copytree(photos, tmp_path / "photos")
    drawn = run("detect", "photos/cat.jpg", "-o", "photos/drawn", "--max-keypoints", 50)
    assert drawn.exit_code == 0, drawn.output
    refused = run(*command)
    assert refused.exit_code == 2, refused.output
    assert one_sentence(refused.stderr)
    words = " ".join(refused.stderr.split())
    assert "photos/drawn/cat_heatmap.jpg was made by an earlier run" in words
    assert {path.name for path in tmp_path.iterdir()} == {"photos"}
