"""`mien bench quality unfilmed-1`: faces that a clip does not show, by region."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from mien.camera import Camera
from mien.evaluation.scoring import ScoreSettings
from mien.face.params import FaceParams
from mien.lab.benchmarking.unfilmed import Figures, PosedPictures, glasses_masks, score_drawings
from mien.lab.synthetic.posed_faces import posed_faces
from mien.lab.synthetic.recipe import SyntheticRecipe
from mien.lab.synthetic.references import REFERENCES
from mien.lab.synthetic.scene import SyntheticScene
from mien.lab.synthetic.truth import truth_of

FACES = {"rest": {}, "jawOpen": {"jawOpen": 1.0}, "browInnerUp": {"browInnerUp": 1.0}}


@pytest.fixture(scope="module")
def pictures() -> PosedPictures:
    recipe = SyntheticRecipe(
        seconds=0.1, width=128, height=128, hair="none", clothes=False, cameras="oblique", texture_size=256
    )
    scene = SyntheticScene(recipe, 3, faces=[*FACES.values()])
    frames = [scene.timestep_frames(timestep) for timestep in range(3)]
    images = np.stack([np.stack([frame.image for frame in each]) for each in frames])
    return PosedPictures(tuple(FACES), images, truth_of(scene), glasses_masks(scene))


Change = Callable[[torch.Tensor, int, int], torch.Tensor]


def scored(pictures: PosedPictures, change: Change = lambda image, timestep, camera: image) -> Figures:
    """The figures of an avatar that draws the true pictures, after a change."""
    tracking = pictures.truth.tracking

    def draw(face: FaceParams, camera: Camera) -> torch.Tensor:
        timestep = [torch.equal(tracking.face[t].expression, face.expression) for t in range(3)].index(True)
        place = tracking.cameras.index(camera)
        return change(pictures.target(timestep, place), timestep, place)

    figures, sheet = score_drawings(draw, pictures, ScoreSettings(threads=1))
    assert sheet.shape == (256, 1280, 3)
    return figures


def test_faults_are_found_in_their_region_and_true_pictures_are_perfect(pictures: PosedPictures) -> None:
    perfect = scored(pictures)
    assert {"mouth", "teeth", "brows"} <= perfect.keys()
    assert all(own["psnr"] == 100 and own["perceptual"] < 1e-4 for own in perfect.values())
    assert perfect["brows"]["faces"] == 2  # in front and aside
    assert perfect["mouth"]["cross_talk"] < 0.1

    def closed(image: torch.Tensor, timestep: int, camera: int) -> torch.Tensor:
        """The mouth stays shut, and dark brows follow the jaw."""
        mouth = pictures.truth.landmarks[0, camera, [0, 17]].mean(0).astype(int)
        rows = slice(mouth[1] - 4, mouth[1] + 12)
        columns = slice(mouth[0] - 8, mouth[0] + 8)
        image[rows, columns] = pictures.target(0, camera)[rows, columns]
        top = int(pictures.truth.landmarks[0, camera, 168, 1])
        return torch.cat([image[:top] * 0.5, image[top:]]) if timestep == 1 else image

    wrong = scored(pictures, closed)
    assert wrong["teeth"]["psnr"] < 40
    assert wrong["teeth"]["perceptual"] > perfect["teeth"]["perceptual"]
    assert wrong["brows"]["psnr"] == 100
    assert wrong["brows"]["cross_talk"] > 1 > 0.2 > perfect["brows"]["cross_talk"]


def test_references_of_talk_have_no_strong_expressions() -> None:
    talk, everything, faces = REFERENCES["unfilmed-2"].scenes()
    names = talk.model.expression_names
    strongest = dict(zip(names, talk.face.expression.amax(0).tolist(), strict=True))
    assert all(value == 0 for name, value in strongest.items() if name.startswith("brow"))
    assert strongest["jawOpen"] < 0.5 < everything.face.expression.amax(0)[names.index("jawOpen")]
    assert faces.timesteps == len(posed_faces(talk.model)) > 100
    assert len(faces.cameras) == 2
