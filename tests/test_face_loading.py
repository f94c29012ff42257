"""Loading gives the face model, whatever happens on disk; names of faces mean the same everywhere."""

import json
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien import runtime
from mien.face import FaceModel, cache, listing, load_face_model, loading
from mien.face.listing import available_face_models
from mien.formats.glb import morph_targets
from mien.pipeline import drive as driving
from mien.pipeline.expression import tell_of_unfilmed, with_expression
from mien.pipeline.sheets import expression_tiles
from mien.rotation import matrix_from_axis_angle
from mien.runtime.named import EYES, GAZE_NAMES, MOST_UP, presets, presets_for
from mien.runtime.posing import rig_points
from refusals import complaint, refuses
from small_face_model import make_small_face_model
from toy_scene import toy_camera
from web_case import WEB, drawn_head, node


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
        ("json", lambda content: b'{"format": "mien.face_model", "version": 1}'), ("json", None),
        ("safetensors", lambda content: content[:-100]), ("safetensors", flip_a_bit), ("safetensors", None),
    ):  # fmt: skip
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


NAMED = {"eyeLookUpLeft": 0.8, "eyeLookInRight": 0.5, "smile": 0.4, "sadness": 0.5, "jawOpen": 0.2}
"""Names of every kind. Of smile and sadness, no expression is in both."""


@pytest.fixture(scope="module")
def portable() -> runtime.PortableAvatar:
    """A drawn head whose rest is not zero: it looks aside, and its lips are a little up."""
    drawn = drawn_head(200)
    expression, joints = drawn.neutral.expression.copy(), drawn.neutral.joints.copy()
    expression[list(drawn.expression_names).index("mouthSmileLeft")] = 0.1
    joints[[drawn.joint_names.index(eye) for eye in EYES.values()]] = (0.05, -0.1, 0.0)
    return replace(drawn, neutral=replace(drawn.neutral, expression=expression, joints=joints))


model = pytest.fixture(scope="module")(lambda: load_face_model("anny"))


def at_rest(portable: runtime.PortableAvatar, model: FaceModel):
    near = portable.neutral
    given = {name: torch.from_numpy(getattr(near, name))[None].clone() for name in ("expression", "joints")}
    return replace(model.neutral(), **given)


def test_the_table_has_only_names_of_arkit_and_shares(model: FaceModel) -> None:
    for name, values in presets().items():
        assert all(0 < value <= 1 for value in values.values())
        assert set(values) <= {*model.expression_names, *GAZE_NAMES}, name
    assert presets_for(model.expression_names, model.free_joint_names) == list(presets())
    assert presets_for(("jawOpen", "expr_1"), ()) == ["open_mouth"]
    assert "sadness" not in presets_for(model.expression_names, ()), "without eyes, no face looks aside"
    # A wrong value or name is told.
    for assignment, message in (
        ("eyeLookUpLeft=1.2", "eyeLookUpLeft goes from 0 to 1; 1 is 30 degrees aside"),
        ("eyeLookUpLeft=nan", "eyeLookUpLeft goes from 0 to 1"),
        ("smile=2", "smile goes from 0 to 1; 1 is the full expression"),
        ("smlie=0.4", "no expression 'smlie'; did you mean smile"),
        ("tongueOut=0.4", "tongueOut does nothing with the face model 'anny'"),
    ):
        refuses(message, with_expression, model.neutral(), model, (assignment,))


def test_the_command_line_and_the_runtime_agree(portable: runtime.PortableAvatar, model: FaceModel) -> None:
    face = with_expression(at_rest(portable, model), model, tuple(f"{n}={v}" for n, v in NAMED.items()))
    found = runtime.Avatar(portable).face(NAMED)
    np.testing.assert_allclose(found.expression, face.expression[0].numpy(), atol=1e-6)
    np.testing.assert_allclose(found.joints, face.joints[0].numpy(), atol=1e-6)
    index = model.expression_names.index
    assert found.expression[index("mouthSmileLeft")] == pytest.approx(0.1 + 0.4 * 0.7)
    assert found.expression[index("jawOpen")] == pytest.approx(0.2)
    assert np.all(found.expression[[index(name) for name in GAZE_NAMES if name in model.expression_names]] == 0)


@pytest.mark.parametrize("name", GAZE_NAMES)
def test_a_gaze_turns_its_eye_its_way(portable: runtime.PortableAvatar, name: str) -> None:
    found, rest = runtime.Avatar(portable).face({name: 0.5}).joints, portable.neutral.joints
    side, other = ("Left", "Right") if name.endswith("Left") else ("Right", "Left")
    at, still = (portable.joint_names.index(EYES[each]) for each in (side, other))
    np.testing.assert_array_equal(found[still], rest[still])
    ahead = [matrix_from_axis_angle(torch.from_numpy(joints[at])[None])[0, :, 2].numpy() for joints in (found, rest)]
    moved = ahead[0] - ahead[1]
    # In the head frame, +x is to the subject's left, and +y up. Inwards is towards the nose.
    left_is = {"Out": 1, "In": -1}.get(name[7 : -len(side)], 0) * (1 if side == "Left" else -1)
    up_is = {"Up": 1, "Down": -1}.get(name[7 : -len(side)], 0)
    assert moved[0] * left_is > 0.2 if left_is else abs(moved[0]) < 0.03
    assert moved[1] * up_is > 0.15 if up_is else abs(moved[1]) < 0.03


def test_sheets_and_glb_files_turn_the_eyes_alike(portable: runtime.PortableAvatar, model: FaceModel) -> None:
    face, baked = at_rest(portable, model), portable.baked
    assert isinstance(baked, runtime.MeshBound)
    tiles = {tile.name: tile for tile in expression_tiles(model, face, toy_camera(16), 1.0)}
    rest = runtime.Avatar(portable).face()
    targets = morph_targets(portable, baked.rig, rest)
    for name in GAZE_NAMES:
        expected = runtime.Avatar(portable).face({name: 1.0})
        np.testing.assert_allclose(tiles[f"{name} 1.00"].face.joints[0].numpy(), expected.joints, atol=1e-6)
        moved = rig_points(baked.rig, replace(rest, joints=expected.joints)) - rig_points(baked.rig, rest)
        np.testing.assert_allclose(targets[name], moved, atol=2e-6)
        assert np.abs(moved).max() > 2e-3
    # Eyes turn no farther than lids allow.
    avatar = runtime.Avatar(replace(portable, neutral=replace(portable.neutral, joints=0 * portable.neutral.joints)))
    pitch = avatar.face({"eyeLookUpLeft": 1.0}).joints[portable.joint_names.index("left_eye"), 0]
    assert -MOST_UP < pitch < -0.9 * MOST_UP


def test_pages_agree_with_python(built: Path, tmp_path: Path, portable: runtime.PortableAvatar) -> None:
    """Each name alone, and all in one face. Names that do nothing say so."""
    runtime.write_portable(tmp_path / "head.mien", portable)
    faces: list[dict[str, float]] = [{name: 0.7} for name in (*presets(), *GAZE_NAMES, "jawOpen")]
    faces += [NAMED, {"eyeLookUpLeft": 1.0, "eyeLookOutLeft": 1.0}, {"smile": 9.0}]
    (tmp_path / "faces.json").write_text(json.dumps([*faces, {"smirk": 1.0}, {"tongueOut": 1.0}, {"__proto__": 1.0}]))
    script = [node(), str(WEB / "tests" / "named.mjs"), str(built / "mien.js"), str(tmp_path / "head.mien")]
    done = subprocess.run([*script, str(tmp_path / "faces.json")], check=True, capture_output=True, text=True)
    told = json.loads(done.stdout)
    assert [one["works"] for one in told] == [True] * len(faces) + [False] * 3
    for given, one in zip(faces, told, strict=False):
        expected = runtime.Avatar(portable).face({name: min(value, 1.0) for name, value in given.items()})
        np.testing.assert_allclose(one["expression"], expected.expression, atol=1e-6, err_msg=str(given))
        np.testing.assert_allclose(np.reshape(one["joints"], (-1, 3)), expected.joints, atol=1e-6, err_msg=str(given))


def test_a_preset_beyond_what_was_filmed_is_told(model: FaceModel, capsys: pytest.CaptureFixture[str]) -> None:
    zero = np.zeros(len(model.expression_names) + 3 * len(model.free_joint_names), np.float32)
    highest = zero.copy()
    highest[model.expression_names.index("mouthSmileLeft")] = 1
    filmed = runtime.Filmed(zero, highest, np.zeros((2, 2), np.float32))
    given = ("smile=0.5", "eyeLookUpLeft=0.5")
    tell_of_unfilmed(given, with_expression(model.neutral(), model, given), model, filmed)
    told = capsys.readouterr().err
    assert "mouthSmileRight=0.35 (0.00 to 0.00)" in told.replace("\n", " ")
    assert "mouthSmileLeft" not in told
