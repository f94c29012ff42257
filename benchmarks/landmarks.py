"""Place MediaPipe's 478 landmarks on a face model: `python benchmarks/landmarks.py anny`."""

from dataclasses import replace
from importlib import resources
from pathlib import Path

import tyro

from mien.face.loading import load_face_model_without_landmarks, write_landmarks
from mien.machine.progress import say
from mien.tracking.landmarks.embedding import EmbeddingSettings, embed_landmarks


def main(name: tyro.conf.Positional[str] = "anny", pictures: int = EmbeddingSettings.pictures) -> None:
    """Place the landmarks of a face model and write them into the package's data.

    Args:
        name: The face model.
        pictures: How many to draw; 240 take about two minutes.
    """
    model = load_face_model_without_landmarks(name)
    landmarks, errors = embed_landmarks(model, EmbeddingSettings(pictures=pictures))
    median = float(errors.median())
    path = Path(str(resources.files("mien.face") / "data" / f"{name}_landmarks.json"))
    command = f"python benchmarks/landmarks.py {name}"
    write_landmarks(path, replace(model, landmarks=landmarks), command, median)
    say(f"{path}: median error {median:.2f} px, largest {float(errors.max()):.2f} px (landmark {int(errors.argmax())})")


if __name__ == "__main__":
    tyro.cli(main)
