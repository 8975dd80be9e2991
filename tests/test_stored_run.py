"""A run folder from a stranger: whatever its files hold, a reader ends in a result or in one sentence."""

import json
import os
import random
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import damaged_runs
import pytest
import strange_runs
import torch
from confined import limited
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from safetensors.torch import load

import shadowgraph
from capture.errors import UserError
from capture.files.atomic import atomic_file
from reconstruct import tensor_file
from reconstruct.export.export import export
from reconstruct.fields import load_fields
from reconstruct.run.bundle import write_bundle
from reconstruct.stored_run.maps import read_thumbnail
from reconstruct.stored_run.stored_run import StoredRun
from reconstruct.tensor_file import Layout, read_tensors, write_tensors
from viewer.display.run_follower import RunFollower, status
from viewer.report.report import read_results, write_report
from viewer.stage.page import kept_pack

ROOT = Path(__file__).parent.parent
READERS = ("fields", "detail", "calibration", "views", "mesh", "maps", "report", "manifest")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return damaged_runs.make(tmp_path_factory.mktemp("whole"))


@pytest.fixture
def run(whole, tmp_path):
    return Path(shutil.copytree(whole, tmp_path / "heap"))


def read_all(run: Path) -> list[str]:
    """Read every file of a run in every way; the sentences of those that were refused."""
    said = []
    stored = StoredRun(run)
    for name in READERS:
        try:
            getattr(stored, name)
        except UserError as error:
            said.append(str(error))
    follower = RunFollower(run)
    assert status(follower.log(), follower.is_running()).title
    follower.thumbnail("photo_00.jpg")
    results = read_results(run)
    assert "\n" not in "".join(said)
    return [*said, *results.problems]


def test_a_whole_run_of_several_views_and_object_poses_is_read_without_a_word(tmp_path):
    run = damaged_runs.make_several(tmp_path)
    assert read_all(run) == []
    assert [name for name, _, _ in StoredRun(run).views] == ["view_1", "view_2", "turned_1"]


@settings(
    max_examples=40,
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(draw=st.randoms(use_true_random=False))
def test_a_damaged_run_is_read_or_refused_in_sentences(whole, tmp_path_factory, draw):
    folder = tmp_path_factory.mktemp("damaged")
    run = Path(shutil.copytree(whole, folder / "heap"))
    (folder / "secret").write_text("{}")
    how = damaged_runs.damaged(draw, run)
    with limited(folder, room=2 << 30, seconds=60) as watch:
        read_all(run)
    assert not (run / "RAN").exists() and not watch.written, how
    assert not [path for path in watch.read if "secret" in os.path.realpath(path)], how
    shutil.rmtree(folder)


def test_a_packed_stage_is_whole_or_counts_as_none(run):
    assert kept_pack(run) is not None
    content = (run / "stage.zip").read_bytes()
    said = set()
    for seed in range(30):
        said.add(strange_runs.by_archive(random.Random(seed), run))
        pack = kept_pack(run)
        assert pack is None or all(isinstance(pack.read(name), bytes) for name in pack.names)
        (run / "stage.zip").write_bytes(content)
    assert len(said) == 10


def test_a_file_of_tensors_is_in_memory_and_not_mapped_so_that_cutting_it_later_harms_nothing(run):
    path = run / "fields.safetensors"
    stored, expected = read_tensors(path).tensors, load(path.read_bytes())
    os.truncate(path, 100)  # under a map, reading on would be a bus error
    assert stored.keys() == expected.keys()
    assert all(torch.equal(stored[name], expected[name]) for name in expected)
    with pytest.raises(ValueError, match="a header of"):
        read_tensors(path)


def test_of_a_file_that_states_other_tensors_than_are_needed_nothing_but_the_header_is_read(run, monkeypatch):
    path = run / "fields.safetensors"
    write_tensors({"sdf": torch.zeros(1 << 20)}, {}, path)
    monkeypatch.setattr(tensor_file, "load", lambda content: pytest.fail("its content was read"))
    for layout in (Layout(torch.float32, (None, None)), Layout(torch.float16, (None,))):
        with pytest.raises(ValueError, match=r"'sdf' is torch.float32 \[1048576\]"):
            read_tensors(path, {"sdf": layout})
    with pytest.raises(ValueError, match="at most 1000 can be read"):
        read_tensors(path, most_numbers=1000)
    for shape, fault in (
        ([1 << 31, 1 << 31], "fits into no file"),
        ([99999, 99999, 9], "fits into no"),
        ([-1], "damaged"),
    ):
        header = json.dumps({"sdf": {"dtype": "F32", "shape": shape, "data_offsets": [0, 4]}}).encode()
        path.write_bytes(len(header).to_bytes(8, "little") + header + bytes(4))
        with pytest.raises(ValueError, match=fault):
            read_tensors(path)


# --- what is no file -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["pipe", "link", "folder", "device", "sparse"])
def test_only_regular_files_of_a_fitting_size_are_opened_and_nobody_waits(kind, run, tmp_path):
    (tmp_path / "secret").write_text("{}")
    names = [n for n in damaged_runs.FILES if "*" not in n and n != "lock"]
    for name in names:
        path = run / name
        path.unlink()
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
        elif kind == "sparse":
            with path.open("wb") as file:
                file.truncate(damaged_runs.SPARSE)
        else:
            path.symlink_to(tmp_path / "secret" if kind == "link" else "/dev/zero")
    with limited(tmp_path, room=1 << 30, seconds=30) as watch:
        said = read_all(run)
    assert not [path for path in watch.read if "secret" in os.path.realpath(path)]
    for name in ("calibration.json", "fields.safetensors", "mesh.ply", "depth.npy", "report.json"):
        assert any(name in line for line in said), name


def test_nothing_is_written_where_a_link_leads(run, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (run / "exports").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="exports is a link"):
        export(run, "ply")
    (tmp_path / "kept").write_text("kept")
    (run / "report.html").symlink_to(tmp_path / "kept")
    (run / f".report.{os.getpid()}.part.html").symlink_to(tmp_path / "kept")
    write_report(run)
    assert (tmp_path / "kept").read_text() == "kept" and not list((tmp_path / "elsewhere").iterdir())
    assert not (run / "report.html").is_symlink()
    with atomic_file(run / "a.txt") as draft:
        draft.write_text("x")


# --- what kernels would have got -------------------------------------------------------------------------------------


def changed(run: Path, name: str, **rest: object) -> None:
    """Other tensors, or values in the JSON of the header, in one of the run's tensor files."""
    tensors, header = damaged_runs._stored(run / name)
    document = json.loads(header["fields"])
    for key, value in rest.items():
        if key in tensors:
            tensors[key] = value  # type: ignore[assignment]
        else:
            document[key] = value
    damaged_runs._save(tensors, header | {"fields": json.dumps(document)}, run / name)


@pytest.mark.parametrize(
    ("rest", "match"),
    [
        ({"spacing": 0.0}, "spacing is 0.0"),
        ({"origin": torch.tensor([float("nan"), 0, 0])}, "'origin' has values from nan"),
        ({"sdf": 100 * torch.randn(8, 8, 8)}, "neighbouring nodes differs by"),
        ({"sdf": torch.randn(48, 48, 48, generator=torch.Generator().manual_seed(0))}, "it is noise"),
        ({"sdf": torch.zeros(1, 4, 4)}, "nodes was found"),
        ({"sdf": torch.zeros(4, 4)}, "'sdf' is torch.float32"),
        ({"albedo": torch.zeros(2, 2, 3).half()}, "pixels of albedo"),
        ({"albedo": torch.full((48, 64, 3), float("nan")).half()}, "'albedo' has values"),
        ({"world_from_camera": torch.diag(torch.tensor([2.0, 1, 1, 1])).double()}, "no rotation"),
        ({"world_from_camera": torch.eye(4).double()}, "a camera above the ground"),
        ({"evidence": torch.zeros(2, 2, 2).half()}, "at all nodes"),
        ({"lobes": torch.zeros(2, 9, 3)}, "weights of lobes"),
        ({"camera": {"width": 10**9, "height": 10**9, "fx": 1e9, "fy": 1e9, "cx": 0, "cy": 0}}, "megapixels"),
        ({"camera": {"width": 64, "height": 48, "fx": -1.0}}, "fx is -1.0"),
    ],
)
def test_fields_that_no_solve_leaves_do_not_reach_a_kernel(rest, match, run):
    changed(run, "fields.safetensors", **rest)
    with pytest.raises(UserError, match=match):
        load_fields(run / "fields.safetensors")


def document_with(run: Path, name: str, change) -> Path:
    document = json.loads((run / name).read_text())
    change(document)
    (run / name).write_text(json.dumps(document))
    return run / name


def test_files_of_two_runs_are_refused_together(run):
    document_with(run, "calibration.json", lambda d: d.update(units="scene"))
    with pytest.raises(UserError, match="one unit was needed"):
        assert StoredRun(run).calibration
    document_with(run, "calibration.json", lambda d: d.update(units="mm"))
    document_with(run, "calibration.json", lambda d: d["lights"][0].update(position=[0, 0, 1e11]))
    with pytest.raises(UserError, match="from the solved surface"):
        assert StoredRun(run).calibration


# --- pictures and pages ----------------------------------------------------------------------------------------------


def test_pictures_are_what_their_names_say_and_small(run, tmp_path):
    from test_untrusted_files import png, tiff

    path = run / "thumbs" / "photo_00.jpg"
    assert read_thumbnail(run, "photo_00.png").shape == (48, 64, 3)
    for data in (png(30_000, 30_000), png(4000, 4000), tiff(64, 48), b"<svg/>", path.read_bytes()[:500]):
        path.write_bytes(data)
        with limited(tmp_path, room=600 << 20), pytest.raises(UserError, match=r"photo_00\.jpg"):
            read_thumbnail(run, "photo_00.jpg")
    (run / "thumbs").rename(tmp_path / "elsewhere")
    (run / "thumbs").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FileNotFoundError):
        read_thumbnail(run, "photo_01.jpg")


def test_no_text_of_a_run_becomes_markup(run):
    """Every text that the schemas let pass, wherever a page shows it."""
    markup = damaged_runs.MARKUP.replace("/", "")
    for name in ("calibration.json", "report.json"):

        def mark(value):
            if isinstance(value, dict):
                kept = ("kind", "units", "lens", "photo", "name", "unit")
                return {key: entry if key in kept else mark(entry) for key, entry in value.items()}
            if isinstance(value, list):
                return [mark(entry) for entry in value]
            return markup if isinstance(value, str) else value

        (run / name).write_text(json.dumps(mark(json.loads((run / name).read_text()))))
    results = read_results(run)
    assert not results.problems
    page = write_report(run).read_text()
    assert "<script>alert" not in page and "<img src=x" not in page and "&lt;script&gt;alert" in page


def test_a_bug_report_tells_nothing_of_where_the_photos_were_taken(run, tmp_path, monkeypatch):
    home = tmp_path / "home" / "ada"
    home.mkdir(parents=True)
    monkeypatch.setenv("HOME", str(home))
    exif = Image.Exif()
    exif[0xA431] = "SERIAL4711"
    exif[0x010F] = "Maker"
    exif.get_ifd(0x8825)[2] = (48.0, 51.0, 29.88)
    for path in (run / "thumbs").iterdir():
        Image.open(path).save(path, exif=exif, comment=b"52.5200 N 13.4050 E")
    assert b"SERIAL4711" in (run / "thumbs" / "photo_00.jpg").read_bytes()
    said = {"command": f"shadowgraph run {home}/scans/vase", "warnings": [f"{home}/scans/vase/a.jpg is blurred"]}
    document_with(run, "report.json", lambda d: d.update(said))
    write_report(run)
    assert not [name for name in write_bundle(run, tmp_path / "a.zip") if name.endswith((".jpg", ".png"))]
    names = write_bundle(run, tmp_path / "b.zip", with_pictures=True)
    assert {"log.jsonl", "report.html", "report.json", "calibration.json", "manifest.json", "machine.json"} <= {*names}
    with zipfile.ZipFile(tmp_path / "b.zip") as packed:
        contents = {name: packed.read(name) for name in packed.namelist()}
    assert sum(name.startswith("thumbs/") for name in contents) == 6
    for name, content in contents.items():
        for secret in (b"SERIAL4711", b"Exif", b"13.4050", str(home).encode(), b"scans"):
            assert secret not in content, (name, secret)


# --- whole commands --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["fields.safetensors", "log.jsonl"])
def test_commands_end_in_one_sentence(name, run, capsys):
    (run / name).unlink()
    os.mkfifo(run / name)
    if name != "log.jsonl":  # which relighting does not read
        assert shadowgraph.main(["relight", str(run), "--light", "1,2,300", "--width", "16"]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and f"{name}" in said and "a pipe" in said
    assert shadowgraph.main(["report", str(run)]) == 0


@pytest.mark.slow
def test_damaged_runs_end_well_in_every_command(tmp_path):
    seed = str(random.Random(os.environ.get("SHADOWGRAPH_SEED", "slow")).randrange(10**6))
    words = [sys.executable, str(ROOT / "benchmarks" / "fuzz_runs.py"), "--runs", "75", "--seed", seed]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stdout[-3000:]
    assert re.search(r"\| together \| +75 ", done.stdout)
