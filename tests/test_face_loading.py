"""Loading gives the face model, whatever happens to the baked files on disk."""

import json
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch

from mien.commands.stages import driving
from mien.face import available_face_models, cache, listing, load_face_model, loading
from refusals import complaint, refuses
from small_face_model import make_small_face_model


@pytest.fixture
def bakes(monkeypatch, tmp_path):
    """Return a source that bakes a small model and counts how often. The cache is a fresh folder."""
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path))
    counts = []

    def bake():
        counts.append(1)
        return make_small_face_model()

    source = listing.Source("none", "an ellipsoid", bake, lambda: "r1-0.0.1")
    monkeypatch.setitem(listing.SOURCES, "small", source)
    return counts


def test_a_baked_model_is_read_as_it_was_baked_and_baked_once(bakes, tmp_path):
    before = {info.name: info for info in available_face_models()}
    assert not before["small"].baked
    assert "CC0" in before["anny"].licence
    baked, read = load_face_model("small"), load_face_model("small")
    assert len(bakes) == 1
    assert {info.name: info.baked for info in available_face_models()}["small"]
    assert read.content_hash == baked.content_hash
    for name in (*loading.TENSORS, *loading.LISTS, "name"):
        first, second = getattr(baked, name), getattr(read, name)
        if isinstance(first, torch.Tensor):
            assert first.dtype == second.dtype
            assert torch.equal(first, second)
        else:
            assert first == second
    (header,) = (json.loads(path.read_text()) for path in tmp_path.glob("face_models/small-r1-0.0.1.json"))
    assert (header["format"], header["version"]) == ("mien.face_model", 1)


def flip_a_bit(content: bytes) -> bytes:
    """Two thirds in, where the bases are: the file is still a valid one."""
    place = len(content) * 2 // 3
    return content[:place] + bytes([content[place] ^ 64]) + content[place + 1 :]


def test_damaged_or_old_files_are_baked_again(bakes, tmp_path):
    baked = load_face_model("small")
    for ending, damage in (
        ("json", lambda content: content[:-100]),
        ("json", lambda content: content.replace(b'"version": 1', b'"version": 0')),
        ("json", lambda content: b'{"format": "mien.face_model", "version": 1}'),
        ("json", None),
        ("safetensors", lambda content: content[:-100]),
        ("safetensors", flip_a_bit),
        ("safetensors", None),
    ):
        path = tmp_path / f"face_models/small-r1-0.0.1.{ending}"
        bakes.clear()
        if damage is None:
            path.unlink()
        else:
            path.write_bytes(damage(path.read_bytes()))
        with ThreadPoolExecutor(4) as pool:
            hashes = set(pool.map(lambda _: load_face_model("small").content_hash, range(4)))
        assert hashes == {baked.content_hash}
        bakes.clear()
        assert load_face_model("small").content_hash == baked.content_hash
        assert not bakes, "it was written again"


def test_unknown_names_and_landmarks_of_another_mesh_are_refused():
    refuses("'flame2077'.*anny", load_face_model, "flame2077")
    model = make_small_face_model()
    refuses("another mesh", loading.read_landmarks, "anny", model)
    # Hashes tell what changed.
    moved = replace(model, template=model.template + 1e-6)
    assert moved.content_hash != model.content_hash
    assert moved.topology_hash == model.topology_hash
    assert replace(model, faces=model.faces.roll(1, 1)).topology_hash != model.topology_hash


@pytest.fixture
def homeless(monkeypatch, tmp_path):
    """Let the home folder be one that cannot be written to."""
    for name in ("MIEN_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", "/proc/nowhere")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    cache.temporary_folder.cache_clear()
    yield
    cache.temporary_folder.cache_clear()


@pytest.mark.parametrize("why", ["there is no home folder", "/proc/nowhere/.cache/mien cannot be written to"])
def test_without_a_home_folder_models_are_baked_for_this_process(why, bakes, homeless, monkeypatch, tmp_path, capsys):
    if why == "there is no home folder":
        monkeypatch.delenv("HOME")
        monkeypatch.setattr("pwd.getpwuid", lambda user: {}[user])
    assert load_face_model("small").content_hash == load_face_model("small").content_hash
    assert len(bakes) == 1
    said = capsys.readouterr().err
    assert said.count("set MIEN_CACHE to keep them") == 1
    assert why in said
    (folder,) = tmp_path.glob("mien-cache-*")
    assert listing.is_baked("small", listing.SOURCES["small"])
    assert str(folder) in said


def test_without_a_home_folder_nothing_is_promised(homeless, monkeypatch, tmp_path, capsys):
    """A driver's tracking is not kept for the next time then, and a face model that is added would be lost."""
    monkeypatch.setattr(driving, "run_capture_stage", lambda *_: None)
    monkeypatch.setattr(driving, "is_picture", lambda _: False)
    monkeypatch.setattr(driving, "run_tracking_stage", lambda *_, **__: {"clip": None})
    (tmp_path / "clip.mp4").write_bytes(b"a video")
    assert not cache.cache_is_kept()
    driving.tracked_film(tmp_path / "clip.mp4", "small")
    said = capsys.readouterr().err
    assert "next time" not in said
    assert "for this command only; set MIEN_CACHE to keep it" in said
    (tmp_path / "model.npz").write_bytes(b"a model")
    assert "there is no folder to keep it in" in complaint(capsys, "face-models", "--add", str(tmp_path / "model.npz"))
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    assert cache.cache_is_kept()
    driving.tracked_film(tmp_path / "clip.mp4", "small")
    assert "kept for the next time" in capsys.readouterr().err
