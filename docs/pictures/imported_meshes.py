"""Make the picture of docs/datasets.md: `python docs/pictures/imported_meshes.py [--all DIR]`.

The writers of the tests draw a person in each layout that has a tracking, larger than in the tests. Each is imported,
and the first picture of its overlay.png is shown. --all keeps the whole overlay of each layout in a folder. Where other
laboratories have no landmarks or mattes, those that were drawn stand for the networks, which know no drawn meshes.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from unittest import mock

import cv2
import numpy as np

ROOT = Path(__file__).parent.parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import dataset_scene  # noqa: E402
import dataset_writers as writers  # noqa: E402
from mien.datasets import pictures, sequences  # noqa: E402
from mien.datasets.dataset import TrackedSequence  # noqa: E402
from mien.datasets.registry import recognised  # noqa: E402
from mien.datasets.writing import write_sequence  # noqa: E402
from mien.face import load_face_model  # noqa: E402

OUT = Path(__file__).parent / "imported_meshes.webp"
ENLARGED, TILE = 4, 240
LAYOUTS = {
    "vhap": writers.write_vhap,
    "insta": writers.write_insta,
    "imavatar": writers.write_imavatar,
    "nersemble-benchmark": writers.write_benchmark,
    "nerface": lambda folder, scene: writers.write_nerface(folder, scene, detected=True),
    "nerf-blendshape": lambda folder, scene: writers.write_nerf_blendshape(folder, scene, 7.0, True),
}
OWN = {"nerface": "coefficients-76", "nerf-blendshape": "coefficients-46"}


def not_white(images: np.ndarray, mattes: np.ndarray, plate: np.ndarray | None = None) -> None:
    """Write mattes of everything that is not white."""
    mattes[:] = 255 * (images < 250).any(-1)


def overlay_of(layout: str, folder: Path, scene: dataset_scene.Scene) -> np.ndarray:
    """Write a person in a layout, import it, and return the overlay of its first sequence."""
    given = LAYOUTS[layout](folder / layout, scene)
    dataset, _ = recognised(given)
    model = load_face_model(OWN[layout]) if layout in OWN else scene.model
    found = next(iter(dataset.read(given, model)))  # type: ignore[arg-type]
    assert isinstance(found, TrackedSequence)
    write_sequence(folder / "out" / layout, found, dataset, given)
    pixels = cv2.imread(str(folder / "out" / layout / "tracking/overlay.png"))
    assert pixels is not None
    return pixels


def main() -> None:
    """Make the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--all", type=Path, metavar="DIR")
    kept = parser.parse_args().all
    for module in (dataset_scene, writers):
        vars(module)["SIDE"] *= ENLARGED
    for matrix in (writers.OFF_CENTRE, writers.UNEQUAL):
        matrix[:2] *= ENLARGED
    columns = []
    with tempfile.TemporaryDirectory() as name:
        scene = dataset_scene.drawn_person()
        with (
            mock.patch.object(pictures, "fill_mattes", not_white),
            mock.patch.object(sequences, "detected_landmarks", lambda images: writers.nerface_landmarks(scene, images)),
        ):
            for layout in LAYOUTS:
                pixels = overlay_of(layout, Path(name), scene)
                if kept is not None:
                    kept.mkdir(parents=True, exist_ok=True)
                    cv2.imwrite(str(kept / f"{layout}.png"), pixels)
                column = pixels[:, :TILE].copy()
                cv2.putText(column, layout, (6, 474), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (60, 60, 60), 1, cv2.LINE_AA)
                columns.append(column)
    cv2.imwrite(str(OUT), np.concatenate(columns, 1), [cv2.IMWRITE_WEBP_QUALITY, 80])
    print(f"{OUT}: {OUT.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
