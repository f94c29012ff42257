"""Edges of small functions that larger tests do not reach: first and last entries, limits, signs, directions."""

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien import _native, runtime
from mien.arrays import recycled
from mien.camera import camera_from_fov
from mien.capture.person.matte import guided_filter
from mien.disk.config import Range
from mien.disk.files import check_writable, remove_leftovers, write_atomically
from mien.disk.limits import MAX_NUMBER
from mien.errors import UserError
from mien.face.checks import check_face_model
from mien.face.mirror import triangle_geometry
from mien.lab.synthetic.recipe import Segment, SyntheticRecipe
from mien.pipeline.expression import with_expression
from mien.render.camera_paths import turned_camera
from mien.runtime.camera_paths import sway, zoom_for_all
from mien.tracking.fitting.views import Views
from mien.tracking.scoring import cut_matte
from refusals import refuses
from small_face_model import make_small_face_model
from toy_scene import toy_camera, toy_face


def test_a_fitted_view_keeps_its_middle_and_a_resized_one_scales_each_axis() -> None:
    camera = camera_from_fov(0.5, 100, 200)
    axis = torch.tensor([[0.0, 0.0, 1.0]])
    for zoom in (1.0, 0.7, 2.5):
        fitted = camera.fitted(300, 90, zoom)
        torch.testing.assert_close(fitted.project(axis)[0], torch.tensor([[150.0, 45.0]]))
        assert float(fitted.K[0, 0]) == pytest.approx(float(camera.K[0, 0]) * zoom * 90 / 200)
    K = np.array([[300, 0, 90], [0, 320, 60], [0, 0, 1]], np.float32)
    resized = runtime.Camera(K, np.eye(4, dtype=np.float32), 200, 100).resized(100, 300)
    assert (resized.width, resized.height) == (100, 300)
    assert resized.K.tolist() == [[150, 0, 45], [0, 960, 180], [0, 0, 1]]
    # Heads are drawn smaller until they reach neither the top nor a side.
    for edge, wanted in ((np.s_[0, 4], 0.7), (np.s_[4, 0], 0.7), (np.s_[4, -1], 0.7), (np.s_[-1, 4], 1.0)):
        masks = {zoom: np.zeros((9, 9), bool) for zoom in (1.0, 0.85, 0.7)}
        masks[1.0][edge] = masks[0.85][edge] = True
        assert zoom_for_all(masks.__getitem__) == wanted


def test_a_synthetic_clip_has_the_number_of_frames_nearest_to_its_length() -> None:
    for seconds, fps, timesteps in ((0.29, 100.0, 29), (0.1, 25.0, 2), (0.15, 25.0, 4), (1e-3, 25.0, 1)):
        recipe = SyntheticRecipe(seconds=seconds, fps=fps)
        assert recipe.timesteps == timesteps
        assert replace(recipe, script=(Segment("still", seconds),)).timesteps == timesteps


def test_ascending_numbers_may_not_repeat_and_the_last_timestep_can_be_taken_by_minus_one() -> None:
    ascending = Range(0, 1, ascending=True)
    assert (ascending.holds((0.2, 0.3)), ascending.holds((0.2, 0.2))) == (True, False)
    face = toy_face(4)
    for index, wanted in ((-1, 3), (0, 0), (-2, 2)):
        assert torch.equal(face[index].expression, face.expression[wanted][None])


def test_numbers_of_faces_and_face_models_have_limits_on_either_side() -> None:
    model = make_small_face_model()
    check_face_model(model, "here", "bake it again")
    for huge in (2 * MAX_NUMBER, -2 * MAX_NUMBER):
        template = model.template.clone()
        template[3, 1] = huge
        with pytest.raises(UserError, match="template holds NaN or numbers beyond"):
            check_face_model(replace(model, template=template), "here", "bake it again")
    rest = model.neutral(2)
    for name, value, beyond in (("move0", 0, -0.01), ("move0", 1, 1.01), ("neck_x", -1, -1.01), ("neck_x", 1, 1.01)):
        face = with_expression(rest, model, (f"{name}={value}",))
        found = face.expression[:, 0] if name == "move0" else face.joints[:, model.free_joint_names.index("neck"), 0]
        assert found.tolist() == [value] * 2
        refuses(f"--set {name}={beyond}: {name} goes from", with_expression, rest, model, (f"{name}={beyond}",))


def test_normals_of_triangles_point_to_where_corners_run_counterclockwise() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 1, 0]])
    middle, area, normal = triangle_geometry(vertices, torch.tensor([[0, 1, 2]]))
    torch.testing.assert_close(normal, torch.tensor([[0.0, 0, 1]]))
    torch.testing.assert_close(area, torch.tensor([1.0]))
    torch.testing.assert_close(middle, torch.tensor([[2 / 3, 1 / 3, 0]]))


def test_a_figure_eight_crosses_itself_in_the_middle_and_an_oval_does_not() -> None:
    camera, center = toy_camera(64), torch.tensor([0.0, 0.0, -0.5])
    for crossing in (True, False):
        views = [turned_camera(camera, center, *angles) for angles in sway(8, 0.6, 0.2, crossing)]
        places = torch.stack([view.position for view in views])
        height, side = places[:, 1], places[:, 0]
        assert float(side[2]) > 0.1 > -0.1 > float(side[6])
        # A quarter of the way it is farthest to one side. A figure eight is at half its height there.
        assert float(height[2]) == pytest.approx(0, abs=1e-6)
        assert float(height[[1, 3]].prod()) == pytest.approx(-float(height[1].square()), rel=1e-3)
        angles = [abs(math.asin(float(height[index]) / 0.5)) for index in ((1, 3) if crossing else (0, 4))]
        assert angles == pytest.approx([0.1, 0.1], abs=1e-3)


def test_the_first_of_chosen_timesteps_keeps_its_pictures() -> None:
    rows, cameras = torch.tensor([0, 0, 1, 2, 3]), torch.tensor([0, 1, 0, 1, 0])
    some = Views(torch.arange(10.0).reshape(5, 1, 2), rows, cameras, torch.ones(5)).at(torch.tensor([3, 0]))
    assert (some.row.tolist(), some.camera.tolist()) == ([1, 1, 0], [0, 1, 0])
    assert some.detected[:, 0, 0].tolist() == [0, 2, 8]


def test_a_guided_filter_is_locally_affine_and_the_matte_beside_the_head_whole_within_a_margin() -> None:
    """Values that are affine in the guide stay, with channels that vary together, as in real pictures."""
    random = np.random.default_rng(5)
    guide = (0.7 * random.random((40, 40, 1)) + 0.3 * random.random((40, 40, 3))).astype(np.float32)
    guide = np.repeat(np.repeat(guide, 2, 0), 2, 1)  # The filter works on every second pixel.
    values = guide @ np.array([0.6, -0.4, 0.8], np.float32) + 0.1
    found = guided_filter(guide, values, 8, 1e-7)
    np.testing.assert_allclose(found[8:-8, 8:-8], values[8:-8, 8:-8], atol=2e-3)
    # A head of 201 columns has a margin of 3 pixels, in which the matte is not cut.
    head = np.zeros((300, 300), bool)
    head[50:250, 50:251] = True
    cut = cut_matte(np.full((300, 300), 255, np.uint8), head, np.full((300, 300), 0.5, np.float32))
    assert (cut[150, 253], cut[150, 254]) == (255, 128)


def test_places_that_can_and_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "there.png").write_bytes(b"old")
    for name, folder in (
        ("there.png", False), ("new.png", False), ("a/b/new.png", False), (".", True), ("a/new", True),
    ):  # fmt: skip
        check_writable(tmp_path / name, folder=folder)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["there.png"]
    os.mkfifo(tmp_path / "pipe")
    for odd in (tmp_path / "pipe", Path("/dev/null")):
        refuses("not an ordinary file", check_writable, odd)
    assert (tmp_path / "there.png").read_bytes() == b"old"
    longest = tmp_path / ("n" * 250 + ".bin")
    check_writable(longest)
    write_atomically(longest, lambda temporary: temporary.write_bytes(b"1"))
    assert longest.read_bytes() == b"1"


def test_what_killed_writers_left_is_removed(tmp_path: Path) -> None:
    path, kept = tmp_path / "overlay.mp4", tmp_path / ".overlay.json"
    for name in (path, kept, tmp_path / ".overlay.mp4.a1b2c3.mp4", tmp_path / ".overlay.mp4.d4.mp4"):
        name.write_bytes(b"1")
    remove_leftovers(path)
    assert sorted(tmp_path.iterdir()) == sorted([path, kept])
    remove_leftovers(tmp_path / "missing" / "overlay.mp4")


# The memory of large pictures is used again ---------------------------------------------------------------------------


def test_memory_is_used_again_but_never_while_somebody_holds_it() -> None:
    first = recycled(1024, 1025)
    assert (first.shape, first.dtype, first.is_contiguous()) == ((1024, 1025), torch.float32, True)
    assert first.data_ptr() % 64 == 0
    address = first.data_ptr()
    view = first[10:].requires_grad_()
    del first
    assert recycled(1024, 1025).data_ptr() != address
    del view
    assert recycled(1024, 1025).data_ptr() == address
    assert (recycled(0, 3).shape, recycled(4, 0).shape) == ((0, 3), (4, 0))
    for many in (_native.recycled, _native.recycled_twice):
        with pytest.raises(ValueError, match="a tensor has at most 64 axes"):
            many([1] * 129)


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (40, 130)])
def test_box_of_nonzero(isa: str, size: tuple[int, int]) -> None:
    values = torch.zeros(size)
    assert _native.box_of_nonzero(values) == (0, 0, 0, 0)
    for pixel in ((size[0] - 1, size[1] // 2), (size[0] // 3, size[1] - 1), (size[0] // 2, size[1] // 3)):
        values[pixel] = 1e-6
        rows, columns = values.nonzero().T
        left, top = int(columns.min()), int(rows.min())
        assert _native.box_of_nonzero(values) == (left, top, int(columns.max()) + 1 - left, int(rows.max()) + 1 - top)
