"""Trackings and scoring masks survive round trips, report damage, and a scoring mask never changes."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from damage import edit_json
from mien.errors import UserError
from mien.storage import read_json, read_tensors, write_tensors
from mien.tracking import (
    Appearance,
    Scoring,
    ScoringSettings,
    Tracking,
    check_scoring_cut,
    read_scoring,
    read_scoring_hash,
    read_tracking,
    scoring_exists,
    write_scoring,
    write_tracking,
)
from small_face_model import make_small_face_model
from tracking_case import still_camera


def _tracking(offsets: bool = False, pixels: bool = False) -> Tracking:
    model = make_small_face_model()
    face = model.neutral(4)
    random = torch.Generator().manual_seed(0)
    face = replace(
        face,
        head_rotation=torch.randn(4, 3, generator=random),
        vertex_offsets=torch.randn(model.template.shape, generator=random) if offsets else None,
    )
    return Tracking(
        face_model="small", face_model_hash="abc", face=face, valid=torch.tensor([True, False, True, True]),
        cameras=(still_camera().to(torch.zeros(())),), neck_lines=torch.tensor([0.0, -1.0, 300.0]).expand(4, 1, 3),
        residuals=torch.tensor([[0.5], [torch.nan], [0.7], [0.6]]),
        pixel_residuals=torch.tensor([[0.02], [torch.nan], [torch.nan], [0.03]]) if pixels else None,
        appearance=_appearance(random) if pixels else None, settings={"focal": None, "keyframes": 20},
    )  # fmt: skip


def _appearance(random: torch.Generator) -> Appearance:
    texture, trust, light = (torch.rand(*shape, generator=random) for shape in ((8, 6, 3), (8, 6), (9, 3)))
    return Appearance(texture, trust, light, sigma=0.03, light_extent=0.012)


@pytest.mark.parametrize("offsets", [False, True])
def test_round_trip(tmp_path, offsets):
    tracking = _tracking(offsets, pixels=offsets)
    write_tracking(tmp_path / "tracking", tracking)
    again = read_tracking(tmp_path / "tracking")
    assert again.face.tensors().keys() == tracking.face.tensors().keys()
    for name, tensor in tracking.face.tensors().items():
        assert torch.equal(tensor, again.face.tensors()[name]), name
    assert (again.face_model, again.face_model_hash, again.settings) == ("small", "abc", tracking.settings)
    assert torch.equal(again.valid, tracking.valid)
    assert torch.equal(again.neck_lines, tracking.neck_lines)
    torch.testing.assert_close(again.residuals, tracking.residuals, equal_nan=True, atol=0, rtol=0)
    if not offsets:
        assert again.pixel_residuals is None
        assert again.appearance is None
    else:
        torch.testing.assert_close(again.pixel_residuals, tracking.pixel_residuals, equal_nan=True, atol=0, rtol=0)
        assert again.appearance is not None
        assert tracking.appearance is not None
        for name in ("texture", "trust", "light"):
            assert torch.equal(getattr(again.appearance, name), getattr(tracking.appearance, name)), name
        assert (again.appearance.sigma, again.appearance.light_extent) == (0.03, 0.012)
    camera, expected = again.cameras[0], tracking.cameras[0]
    assert torch.equal(camera.K, expected.K)
    assert torch.equal(camera.viewmat, expected.viewmat)
    assert (camera.width, camera.height) == (expected.width, expected.height)
    summary = json.loads((tmp_path / "tracking" / "tracking.json").read_text())["residual"]
    assert summary["median_px"] == pytest.approx(0.6)


def _rewrite(folder, change) -> None:
    """Change the tensors and keep the json in step, so that the content is found to be wrong, not the hash."""
    file = folder / "tracking.safetensors"
    tensors = read_tensors(file)
    change(tensors)
    write_tensors(file, tensors)
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    edit_json(folder / "tracking.json", lambda content: content.update(tensors_sha256=digest))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("joints"), "lacks 'joints'"),
        (lambda t: t.update(expression=t["expression"][:2]), "'head_rotation'|'joints'|'expression'"),
        (lambda t: t.update(head_translation=torch.full((4, 3), torch.nan)), "'head_translation' holds numbers"),
        (lambda t: t.update(residuals=torch.full((4, 1), torch.nan)), "'residuals' holds numbers"),
        (lambda t: t.update(camera_K=torch.zeros(1, 2, 3)), "'camera_K' has the shape"),
    ],
)
def test_wrong_content(tmp_path, change, message):
    write_tracking(tmp_path, _tracking())
    _rewrite(tmp_path, change)
    with pytest.raises(UserError, match=message):
        read_tracking(tmp_path)


def test_damage(tmp_path):
    with pytest.raises(UserError, match="missing"):
        read_tracking(tmp_path)
    write_tracking(tmp_path, _tracking())
    edit_json(tmp_path / "tracking.json", lambda content: None)
    tensors, text = tmp_path / "tracking.safetensors", (tmp_path / "tracking.json").read_text()
    whole = tensors.read_bytes()
    tensors.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(UserError, match="differs from what was written"):
        read_tracking(tmp_path)
    tensors.write_bytes(whole[:100])
    with pytest.raises(UserError, match="damaged"):
        read_tracking(tmp_path)
    tensors.write_bytes(whole)
    (tmp_path / "tracking.json").write_text(text.replace('"version": 1', '"version": 7'))
    with pytest.raises(UserError, match="version 7"):
        read_tracking(tmp_path)
    (tmp_path / "tracking.json").write_text(text.replace('"cameras"', '"lenses"'))
    with pytest.raises(UserError, match="incomplete"):
        read_tracking(tmp_path)


def _scoring(value: int = 200) -> Scoring:
    masks = np.zeros((2, 1, 8, 10), np.uint8)
    masks[:, :, 2:6, 3:9] = value
    return Scoring(masks, np.array([[[3, 2, 6, 4]], [[3, 2, 6, 4]]]))


def test_scoring_round_trip_and_frozen(tmp_path):
    folder = tmp_path / "scoring"
    (folder / "masks").mkdir(parents=True)
    assert not scoring_exists(folder), "half written"
    write_scoring(folder, _scoring(), "a1")
    assert scoring_exists(folder)
    again = read_scoring(folder)
    np.testing.assert_array_equal(again.masks, _scoring().masks)
    np.testing.assert_array_equal(again.crops, _scoring().crops)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    write_scoring(folder, _scoring(value=100), "a1")
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    assert list(tmp_path.iterdir()) == [folder], "no scratch folder stays behind"


def test_masks_keep_their_cut(tmp_path):
    """scoring.json names the cut, and another one is refused with the remedy, because masks are written once."""
    folder = tmp_path / "scoring"
    check_scoring_cut(folder, ScoringSettings("line"), "a1")
    write_scoring(folder, replace(_scoring(), cut="line"), "a1")
    assert read_json(folder / "scoring.json", "mien.scoring", 1, "")["cut"] == "line"
    assert read_scoring(folder).cut == "line"
    check_scoring_cut(folder, ScoringSettings("line"), "a1")
    check_scoring_cut(folder, ScoringSettings("plane"), "b2")  # masks of other pictures are made again
    with pytest.raises(UserError, match=r"--scoring.cut plane: .*give --scoring.cut line, or delete that folder"):
        check_scoring_cut(folder, ScoringSettings("plane"), "a1")
    edit_json(folder / "scoring.json", lambda content: content.update(cut="circle"))
    with pytest.raises(UserError, match=r"cut 'circle' is neither plane nor line; delete the folder"):
        read_scoring(folder)
    edit_json(folder / "scoring.json", lambda content: content.pop("cut"))
    assert read_scoring(folder).cut == "plane", "masks from before there was a choice"


def test_damaged_scoring(tmp_path):
    write_scoring(tmp_path / "s", _scoring(), "a1")
    mask = tmp_path / "s" / "masks" / "00" / "000001.png"
    whole = mask.read_bytes()
    mask.write_bytes(whole[:-5])
    with pytest.raises(UserError, match="damaged"):
        read_scoring(tmp_path / "s")
    mask.unlink()
    with pytest.raises(UserError, match="missing"):
        read_scoring(tmp_path / "s")
    write_scoring(tmp_path / "other", _scoring(value=100), "a1")
    mask.write_bytes((tmp_path / "other" / "masks" / "00" / "000001.png").read_bytes())
    with pytest.raises(UserError, match="have changed since they were written"):
        read_scoring(tmp_path / "s")


def test_scoring_of_other_pictures_is_refused(tmp_path):
    write_scoring(tmp_path / "s", _scoring(), capture_hash="a1")
    assert read_scoring(tmp_path / "s", "a1").masks.max() == 200
    with pytest.raises(UserError, match=r"other pictures than the capture beside it; run `mien track` again"):
        read_scoring(tmp_path / "s", "b2")
    edit_json(tmp_path / "s" / "scoring.json", lambda content: content.pop("capture_hash"))
    with pytest.raises(UserError, match="other pictures than the capture beside it"):
        read_scoring(tmp_path / "s", "a1")


def test_the_hash_of_a_scoring_is_over_masks_and_crops(tmp_path):
    """The hash of a scoring covers masks and crops. Figures of other runs name it, so it must not change."""
    write_scoring(tmp_path / "s", _scoring(), "a1")
    digest = hashlib.sha256(_scoring().masks.tobytes() + _scoring().crops.astype(np.int32).tobytes()).hexdigest()
    assert read_scoring_hash(tmp_path / "s") == digest
    other = _scoring()
    other.crops[1, 0, 2] += 1
    write_scoring(tmp_path / "crops", other, "a1")
    write_scoring(tmp_path / "masks", _scoring(value=201), "a1")
    assert len({read_scoring_hash(tmp_path / name) for name in ("s", "crops", "masks")}) == 3
