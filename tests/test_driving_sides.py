"""Coefficients with a side move that side of a drawn face, in recordings of every source."""

from collections.abc import Callable
from pathlib import Path

import pytest

from mien.driving import ARKIT_NAMES, face_of_motion, read_blendshape_json, read_live_link_face
from mien.driving.sides import PAIRS, SOURCES
from mien.face import load_face_model
from recordings import LAYOUTS, Frames

PERFORMERS = [name for pair in PAIRS for name in pair]
OBSERVERS = {"Live Link Face (.csv)": ("jawLeft", "jawRight", "mouthLeft", "mouthRight")}
"""Coefficients whose left is the right of the face, by source: `mien.driving.sides` once more, on purpose."""
SLIDES = ("jawLeft", "jawRight", "mouthLeft", "mouthRight")


def test_every_coefficient_with_a_side_is_in_the_table() -> None:
    assert len(PERFORMERS) == len(set(PERFORMERS)) == 40
    assert {name for name in ARKIT_NAMES if "Left" in name or "Right" in name} == set(PERFORMERS)
    assert set(LAYOUTS) == set(SOURCES)
    for source, sides in SOURCES.items():
        observed = [name for name in PERFORMERS if sides.of(name).value == "observer"]
        assert sorted(observed) == sorted(OBSERVERS.get(source, ()))


def test_the_table_in_the_docs_is_the_table_of_the_code() -> None:
    text = (Path(__file__).parents[1] / "docs" / "conventions.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    told = {row[0]: row[1:4] for row in rows if row[0] in SOURCES}
    assert told == {name: [sides.parts.value, sides.jaw.value, sides.mouth.value] for name, sides in SOURCES.items()}


@pytest.mark.parametrize(
    ("source", "write"), [(source, write) for source, writers in LAYOUTS.items() for write in writers]
)
def test_each_coefficient_moves_its_side_of_a_face(
    source: str, write: Callable[[Path, Frames], Path], tmp_path: Path
) -> None:
    """The subject's left is +x. A slide moves points to its side, and all others move points on their side."""
    path = write(tmp_path, [{}, *({name: 1.0} for name in PERFORMERS)])
    motion = read_live_link_face(path) if path.suffix == ".csv" else read_blendshape_json(path)
    assert len(motion) == 1 + len(PERFORMERS)
    model = load_face_model("anny")
    face, _ = face_of_motion(motion, model)
    vertices = model.head_vertices(face)
    moved = vertices[1:] - vertices[:1]
    on_left = vertices[0, :, 0] > 0
    for index, name in enumerate(PERFORMERS):
        size = moved[index].norm(dim=1)
        assert size.max() > 1e-3, name
        is_left = name.endswith("Left") != (name in OBSERVERS.get(source, ()))
        to_left = moved[index, :, 0].sum() if name in SLIDES else size[on_left].sum() - size[~on_left].sum()
        assert bool(to_left > 0) == is_left, name
    for name, way in (("eyeLookInLeft", -1), ("eyeLookOutLeft", 1), ("eyeLookInRight", 1), ("eyeLookOutRight", -1)):
        irises = moved[PERFORMERS.index(name)][model.faces[model.region_mask("irises")].long().flatten()]
        assert way * irises[:, 0].sum() > 0, name
