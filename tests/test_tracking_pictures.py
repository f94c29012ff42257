"""Pictures of a tracking are right: renderings of the model, heat, overlay, contact sheet, and the report's page."""

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

from mien.capture.video import probe_video
from mien.parallel import stream_in_threads
from mien.render.mesh import shade
from mien.rotation import matrix_from_axis_angle
from mien.tracking import (
    Appearance,
    Tracking,
    TrackingSettings,
    residual_report,
    track,
    write_overlay,
    write_residual_report,
)
from mien.tracking.pixels import SkinTexture, even_light, model_pictures, window_of
from mien.tracking.pixels.outcome import appearance_in_world, turn_light
from mien.tracking.report.contact_sheet import sheet_frames, sheet_rows, worst_of_runs
from mien.tracking.report.heat import heat_map
from mien.tracking.report.overlay import OverlayPainter, overlay_stride
from mien.tracking.report.page import findings, name_runs
from mien.tracking.settings import PaperSettings, PhotometricSettings
from photometric_case import FOCAL, SIZE, PhotometricCase, make_photometric_case, smooth_noise

FAST = TrackingSettings(focal=FOCAL, photometric=PhotometricSettings(texture_size=128, keyframes=8, shared_steps=1))


@pytest.fixture(scope="module")
def case() -> PhotometricCase:
    return make_photometric_case(timesteps=6)


@pytest.fixture(scope="module")
def truth(case: PhotometricCase) -> Tracking:
    """Return a fit with the texture that the pictures were drawn with, and without shading."""
    texture = smooth_noise(256, 256, 4.0)
    return Tracking(
        face_model=case.model.name, face_model_hash="", face=case.face, valid=torch.ones(6, dtype=torch.bool),
        cameras=(case.camera,), neck_lines=torch.tensor([0.0, -1.0, 120.0]).expand(6, 1, 3),
        residuals=torch.full((6, 1), 0.5), pixel_residuals=torch.full((6, 1), 0.01),
        appearance=Appearance(texture, torch.ones(256, 256), even_light(), sigma=0.02, light_extent=0.02),
        settings={"schedule": "fast"},
    )  # fmt: skip


def test_the_true_model_looks_like_the_pictures(case, truth):
    pictures = model_pictures(case.capture, truth, case.model)
    assert pictures is not None
    vertices = case.model(case.face)
    compared = pictures.compare(2, 0, vertices[2])
    known = compared.difference.isfinite()
    assert known.float().mean() > 0.2
    assert compared.difference[known].median() < 0.03
    assert compared.rms < 0.04
    part = torch.from_numpy(case.capture.images[2, 0][compared.window.rows, compared.window.columns] / np.float32(255))
    assert (compared.image - part)[known].abs().median() < 0.03, "the model's picture is not of the same place"
    elsewhere = pictures.compare(2, 0, vertices[2] + torch.tensor([0.01, 0.0, 0.0]))
    assert elsewhere.rms > 2 * compared.rms, "a shift by four pixels is not seen"


def test_a_face_outside_the_picture_is_compared_with_nothing(case, truth):
    pictures = model_pictures(case.capture, truth, case.model)
    assert pictures is not None
    for shift in ([5.0, 0.0, 0.0], [0.0, 0.0, 3.0]):
        compared = pictures.compare(0, 0, case.model(case.face)[0] + torch.tensor(shift))
        assert np.isnan(compared.rms)
        assert compared.difference.isnan().all()
    assert window_of(case.camera, torch.full((3, 3), 9.0)).rows.stop <= SIZE


def test_turned_light_falls_on_turned_normals_alike():
    random = torch.Generator().manual_seed(0)
    light, normals = torch.randn(9, 3, generator=random), torch.randn(20, 3, generator=random)
    normals = torch.nn.functional.normalize(normals, dim=1)
    R_world_fit = matrix_from_axis_angle(torch.tensor([0.4, -1.0, 0.3]))
    torch.testing.assert_close(
        shade(normals @ R_world_fit.T, turn_light(light, R_world_fit)), shade(normals, light), atol=1e-5, rtol=0
    )
    T_world_fit = torch.eye(4).double()
    T_world_fit[:3, :3] = R_world_fit
    appearance = appearance_in_world(SkinTexture(torch.zeros(2, 2, 3), torch.ones(2, 2), 0.1), light, T_world_fit, 0.01)
    torch.testing.assert_close(appearance.light, turn_light(light, R_world_fit), atol=1e-5, rtol=0)


def test_heat_grows_with_the_difference():
    heat = heat_map(np.array([[0.0, 0.03, 0.08, 0.15, 9.0, np.nan]], np.float32)).astype(int).sum(-1)[0]
    assert heat[0] < heat[1] < heat[2] < heat[3] == heat[4]
    assert heat[5] == heat[0]


def test_the_overlay_shows_where_colors_differ(case, truth, tmp_path):
    off = truth.face.head_translation.clone()
    off[3] += torch.tensor([0.01, 0.0, 0.0])
    painter = OverlayPainter(case.capture, replace(truth, face=replace(truth.face, head_translation=off)), case.model)
    assert painter.picture(3).shape == (2 * SIZE, 2 * SIZE, 3)
    good, bad = (painter.panels(timestep)[3].astype(int).sum(-1) for timestep in (2, 3))
    rows, columns = painter.head_box(3)
    assert bad[rows, columns].mean() > 1.3 * good[painter.head_box(2)].mean()
    write_overlay(tmp_path / "overlay.mp4", case.capture, truth, case.model, every=4)
    assert probe_video(tmp_path / "overlay.mp4").frames == 2
    assert probe_video(tmp_path / "overlay.mp4").fps == pytest.approx(case.capture.fps / 4)


def test_without_looks_the_overlay_has_two_panels(case, truth):
    painter = OverlayPainter(case.capture, replace(truth, appearance=None, pixel_residuals=None), case.model)
    assert painter.picture(0).shape == (SIZE, 2 * SIZE, 3)


def test_long_clips_are_shown_in_part():
    assert [overlay_stride(timesteps) for timesteps in (1, 120, 121, 15000)] == [1, 1, 2, 125]


def test_results_come_in_order_and_few_wait(monkeypatch):
    monkeypatch.setenv("MIEN_THREADS", "3")
    started, lock = [], threading.Lock()

    def double(item: int) -> int:
        with lock:
            started.append(item)
        return 2 * item

    stream = stream_in_threads(double, range(50))
    assert [next(stream), next(stream)] == [0, 2]
    assert len(started) <= 2 + 3 + 2 + 1, "all are made at once: long clips do not fit"
    assert list(stream) == [2 * item for item in range(2, 50)]


def test_the_sheet_has_what_stands_out(case, truth):
    residuals = truth.pixel_residuals.clone()
    residuals[4], residuals[1] = 0.2, torch.nan
    odd = replace(truth, pixel_residuals=residuals)
    frames = sheet_frames(odd, flagged=[3, 4], alone=[1])
    assert [frame.timestep for frame in frames] == sorted({frame.timestep for frame in frames})
    assert {frame.timestep: frame.why for frame in frames if frame.why} == {4: "flagged", 1: "landmarks only"}
    rows = sheet_rows(case.capture, odd, case.model, frames)
    assert [(row.name, row.odd) for row in rows if row.odd] == [
        ("Frame 1, landmarks only", True),
        ("Frame 4, flagged", True),
    ]
    assert {tile.shape for row in rows for tile in row.tiles} == {(240, 240, 3)}
    assert {len(row.tiles) for row in rows} == {4}
    assert worst_of_runs([2, 3, 7], np.array([0, 0, 1, 5, 0, 0, 0, 3.0])) == [3, 7]
    assert name_runs([3, 7, 8, 9, 12]) == "3, 7-9, 12"


@pytest.mark.unchecked
@pytest.mark.parametrize(("schedule", "appearance", "alone", "said"), [
    ("fast", True, 0, "Pixels were used in all 6 frames"),
    ("fast", True, 2, "Pixels did not improve 2 of 6 frames with a face, so landmarks alone determined them: 0-1."),
    ("fast", False, 6, "landmarks alone determined all frames"),
    ("landmarks", False, 6, "fitted to landmarks alone"),
])  # fmt: skip
def test_the_page_says_aloud_what_decided(case, truth, tmp_path, schedule, appearance, alone, said):
    residuals = truth.pixel_residuals.clone()
    residuals[:alone] = torch.nan
    shown = replace(
        truth, settings={"schedule": schedule}, appearance=truth.appearance if appearance else None,
        pixel_residuals=residuals if appearance else None,
    )  # fmt: skip
    told = write_residual_report(tmp_path, case.capture, shown, case.model)
    assert said in told
    page = (tmp_path / "report.html").read_text()
    assert said in page
    panels = 4 if appearance else 2
    assert page.count("data:image/") == panels * page.count('<figure class="card">') + 1, "all panels, and the poster"
    assert page.index("<video") < page.index("Findings")
    assert page.count("<svg") == (5 if appearance else 4)
    assert 'class="dot second"' in page or not residual_report(case.capture, shown, case.model)["flagged_frames"]
    odd = [text for kind, text in findings(shown, residual_report(case.capture, shown, case.model)) if kind == "odd"]
    assert (said in odd) or said.split(" so ")[0] in " ".join(odd) or schedule == "landmarks" or alone == 0


@pytest.mark.parametrize("schedule", ["fast", "paper"])
def test_tracked_faces_have_looks(case, schedule):
    short = PaperSettings(first_steps=60, steps=5, epochs=1, texture_size=128)
    tracking = track(case.capture, case.model, replace(FAST, schedule=schedule, paper=short))
    pictures = model_pictures(case.capture, tracking, case.model)
    assert pictures is not None
    assert pictures.compare(3, 0, case.model(tracking.face[3])[0]).rms < 0.08
    assert tracking.pixel_residuals is not None
    assert tracking.pixel_residuals.median() < 0.08
    assert residual_report(case.capture, tracking, case.model)["landmarks_only_frames"] == []


@pytest.mark.unchecked
def test_calibrated_cameras_in_another_world_are_compared_too(case, tmp_path):
    """Calibrated cameras in another world are compared, too: light turns into the world, and cameras form a grid."""
    W_other = torch.eye(4)
    W_other[:3, :3] = matrix_from_axis_angle(torch.tensor([0.3, 1.2, -0.2]))
    W_other[:3, 3] = torch.tensor([1.0, 2.0, -0.5])
    camera = replace(case.camera, viewmat=case.camera.viewmat @ torch.linalg.inv(W_other))
    slope = np.linspace(0.5, 1.2, SIZE, dtype=np.float32)[:, None]
    images = np.clip(case.capture.images * slope, 0, 255).astype(np.uint8)
    both = {name: np.repeat(getattr(case.capture, name), 2, axis=1) for name in ("mattes", "landmarks", "valid")}
    capture = replace(
        case.capture, **both, images=np.repeat(images, 2, axis=1), camera_ids=("a", "b"), calibration=(camera, camera),
        principal_point=np.repeat(case.capture.principal_point, 2, axis=0),
    )  # fmt: skip
    tracking = track(capture, case.model, FAST)
    assert tracking.pixel_residuals is not None
    pictures = model_pictures(capture, tracking, case.model)
    assert pictures is not None
    vertices = case.model(tracking.face[3])[0]
    found = [pictures.compare(3, index, vertices).rms for index in (0, 1)]
    assert found[0] == found[1]
    assert found[0] == pytest.approx(float(tracking.pixel_residuals[3, 0]), rel=0.3)
    assert tracking.appearance is not None
    unturned = replace(tracking.appearance, light=turn_light(tracking.appearance.light, W_other[:3, :3].T))
    wrong = model_pictures(capture, replace(tracking, appearance=unturned), case.model)
    assert wrong is not None
    assert wrong.compare(3, 0, vertices).rms > 1.02 * found[0]
    write_overlay(tmp_path / "overlay.mp4", capture, tracking, case.model, every=3)
    assert probe_video(tmp_path / "overlay.mp4").frames == 2
    write_residual_report(tmp_path, capture, tracking, case.model)
    assert (tmp_path / "report.html").is_file()
