"""Write the conformance set: drawn people as avatars, their faces, and pictures by mien's own renderer. All is CC0.

    .venv/bin/python web/conformance/make.py --out web/conformance/set

`npm run conformance` in web serves the page that draws it by an engine and prints a table.
"""

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from mien import runtime
from mien.avatar.baking import make_portable
from mien.avatar.gaussian_avatars.avatar import GaussianAvatars
from mien.avatar.gaussian_avatars.settings import as_published
from mien.avatar.ops.triangle_frames import triangle_frames
from mien.camera import camera_from_fov, look_at
from mien.formats.shared.packed import pack, unpacked
from mien.lab.synthetic.recipe import SyntheticRecipe
from mien.lab.synthetic.scene import SyntheticScene
from mien.lab.synthetic.subject import Material
from mien.render.mesh import sample_texture
from mien.rotation import quaternion_from_matrix

PEOPLE = ("short", "long", "none")
"""Hair of the people. The second one's colours, opacities and centres change with the face."""
BACKGROUND = (0.9, 0.85, 0.8)
FOV = 25.0
VIEWS = ((0.0, 0.03, 0.85), (0.5, 0.08, 0.68), (-0.42, -0.1, 0.72))
TARGET = (0.0, 0.0, 0.0)
SECOND = (0.1, 0.02, 0.06)
"""Where the second of two avatars stands."""
BOXES = {"before": ((0.05, -0.05, 0.22), 0.05), "behind": ((-0.07, 0.06, -0.2), 0.16)}
BOX_COLOR = (0.1, 0.2, 0.8)
FACES = (
    {}, {"smile": 1}, {"jawOpen": 0.8}, {"eyeBlinkLeft": 1}, {"surprise": 1}, {"anger": 0.8}, {"mouthPucker": 0.9},
    {"browInnerUp": 1, "eyeLookUpLeft": 1, "eyeLookUpRight": 1}, {"laugh": 1},
    {"eyeLookOutLeft": 1, "eyeLookInRight": 1},
)  # fmt: skip


def to_screen(linear: np.ndarray) -> np.ndarray:
    """Return sRGB of linear light."""
    linear = linear.clip(0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def drawn_person(hair: str, seed: int, count: int) -> runtime.PortableAvatar:
    """Return a drawn person with `count` Gaussians, of which a third are hair."""
    recipe = SyntheticRecipe(hair=hair, glasses=False, clothes=False, texture_size=512)  # type: ignore[arg-type]
    scene, random = SyntheticScene(recipe, seed), np.random.default_rng(seed)
    subject = scene.subject
    rest = replace(subject.model.neutral(1), identity=scene.identity)
    camera = camera_from_fov(
        math.radians(FOV), 512, 512, look_at(torch.tensor(VIEWS[0]), torch.zeros(3), torch.tensor([0.0, 1, 0]))
    )
    portable = make_portable(GaussianAvatars(as_published(), subject.model, rest), camera, f"drawn {hair}")
    baked = portable.baked
    assert isinstance(baked, runtime.MeshBound)
    vertices, faces = baked.rig.template, baked.faces
    frames = triangle_frames(torch.from_numpy(vertices), torch.from_numpy(faces))
    R, T, k = (part.numpy() for part in (frames.R, frames.T, frames.k))
    strands = [part for part in subject.hair[:1] if hair != "none"]
    skin = count if not strands else count * 2 // 3
    # Points of the skin, by area.
    corners = vertices[faces[subject.model_faces]]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    row = np.sort(random.choice(len(area), skin, p=area / area.sum()))
    weights = random.dirichlet((1, 1, 1), skin).astype(np.float32)
    at = np.einsum("nc,nci->ni", weights, corners[row])
    index = subject.model_faces[row]
    color = skin_color(subject, row, weights)
    size = np.float32(0.9 * math.sqrt(area.sum() / skin))
    light = 0.35 + 0.65 * (R[index, :, 1] @ np.array([0.25, 0.5, 0.83])).clip(0, 1)
    color = color * light[:, None]
    scales = np.tile([size, 0.2 * size, size], (skin, 1)) / k[index, None]
    quats = np.tile([1.0, 0, 0, 0], (skin, 1))
    if strands:
        parts = hair_parts(strands[0], count - skin, T, R, k, index, random)
        index, at, color, scales, quats = (
            np.concatenate(pair) for pair in zip((index, at, color, scales, quats), parts, strict=True)
        )
    order = np.argsort(index, kind="stable")
    index, at, color, scales, quats = (part[order] for part in (index, at, color, scales, quats))
    means = np.einsum("nji,nj->ni", R[index], at - T[index]) / k[index, None]
    sh = (to_screen(color) - 0.5)[:, None] / 0.28209479177387814
    attributes = runtime.Attributes(
        *(np.ascontiguousarray(part, np.float32) for part in (quats, np.log(scales), np.full(count, 2.2), sh))
    )
    baked = replace(baked, face_index=index.astype(np.int32), means=means.astype(np.float32), attributes=attributes)
    return replace(
        portable, baked=replace(baked, changes=changes_of(portable, count, random)) if hair == "long" else baked
    )


def skin_color(subject, row: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return linear colours of points of the skin, the eyes, the teeth and the mouth."""
    uv_faces = subject.model.uv_faces.numpy()[subject.model_faces]
    uv = np.einsum("nc,nci->ni", weights, subject.textures.uv[uv_faces[row]]).astype(np.float32)
    color = sample_texture(torch.from_numpy(subject.textures.channels), torch.from_numpy(uv)[None])[0].numpy()[:, :3]
    material = subject.materials[: len(subject.model_faces)][row]
    irises = subject.anatomy.region("irises")[subject.model_faces][row]
    for kind, value in (
        (Material.EYE, (0.8, 0.78, 0.75)),
        (Material.TEETH, (0.75, 0.7, 0.6)),
        (Material.MOUTH, (0.25, 0.06, 0.06)),
    ):
        color[material == kind] = value
    color[irises] = subject.iris_color
    return color


def hair_parts(strands, count: int, T, R, k, near: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Return triangles, places, linear colours, scales and rotations of Gaussians along strands."""
    if hasattr(strands, "rest"):
        strands = strands.rest
    n, s = strands.widths.shape
    strand, point = random.integers(0, n, count), random.integers(0, s - 1, count)
    a, b = strands.points[strand, point], strands.points[strand, point + 1]
    at, along = (a + b) / 2, b - a
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = along / length.clip(1e-9)
    triangles = np.unique(near)
    index = triangles[
        np.concatenate(
            [
                torch.cdist(torch.from_numpy(block), torch.from_numpy(T[triangles])).argmin(1).numpy()
                for block in np.array_split(at.astype(np.float32), 20)
            ]
        )
    ]
    side = np.cross(along, strands.outwards[strand, point])
    side /= np.linalg.norm(side, axis=1, keepdims=True).clip(1e-9)
    turn = np.stack([along, side, np.cross(along, side)], -1)
    local = np.einsum("nji,njk->nik", R[index], turn).astype(np.float32)
    quats = quaternion_from_matrix(torch.from_numpy(local)).numpy()
    scales = np.concatenate([length, np.full((count, 2), 0.0012)], 1).clip(4e-4) / k[index, None]
    return index, at, strands.colors[strand, point], scales, quats


def changes_of(portable: runtime.PortableAvatar, count: int, random: np.random.Generator) -> runtime.ExpressionChanges:
    """Return changes of colours, opacities and centres along the open jaw and the smile."""
    inputs = len(portable.neutral.expression) + portable.neutral.joints.size
    directions = np.zeros((inputs, 2), np.float32)
    for column, name in enumerate(("jawOpen", "mouthSmileLeft")):
        directions[portable.expression_names.index(name), column] = 1

    def some(spread: float, *shape: int) -> np.ndarray:
        return (spread * random.standard_normal((count, *shape))).astype(np.float32)

    rest, seen = (
        np.concatenate([portable.neutral.expression, portable.neutral.joints.reshape(-1)]),
        np.eye(2, dtype=np.float32),
    )
    return runtime.ExpressionChanges(rest, directions, seen, some(0.15, 3, 2), some(0.3, 2), some(0.02, 3, 2))


def camera_at(eye: tuple[float, float, float], side: int) -> runtime.Camera:
    """Return the camera at a place of the scene that looks at the target."""
    made = camera_from_fov(
        math.radians(FOV), side, side, look_at(torch.tensor(eye), torch.tensor(TARGET), torch.tensor([0.0, 1, 0]))
    )
    return runtime.Camera(made.K.numpy(), made.viewmat.numpy(), side, side)


def placed(posed: runtime.Gaussians, place: tuple[float, float, float] = (0, 0, 0)) -> runtime.Gaussians:
    """Return Gaussians of the head frame at a place of the scene."""
    parts = vars(posed) | {
        "means": posed.means + np.array(place, np.float32),
        "T_world_local": np.eye(4, dtype=np.float32),
    }
    return runtime.Gaussians(**parts)


def both(first: runtime.Gaussians, second: runtime.Gaussians) -> runtime.Gaussians:
    """Return the Gaussians of two heads as one."""
    parts = {
        name: np.concatenate([part, getattr(second, name)])
        for name, part in vars(first).items()
        if name != "T_world_local"
    }
    return runtime.Gaussians(**parts, T_world_local=first.T_world_local)


def write_picture(path: Path, image: np.ndarray) -> str:
    """Write colours or alphas of 0 to 1, and return the file's name."""
    pixels = (255 * image.clip(0, 1) + 0.5).astype(np.uint8)
    cv2.imwrite(str(path), pixels if pixels.ndim == 2 else pixels[..., ::-1])
    return path.name


def main() -> None:
    """Write the set that the command line asks for."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--gaussians", type=int, default=40_000)
    parser.add_argument("--side", type=int, default=512, help="pixels of a picture")
    parser.add_argument("--faces", type=int, default=len(FACES))
    parser.add_argument("--people", type=int, default=len(PEOPLE))
    options = parser.parse_args()
    out, side = options.out, options.side
    out.mkdir(parents=True, exist_ok=True)
    told, posed = [], None
    for seed, hair in enumerate(PEOPLE[: options.people]):
        portable = unpacked(drawn_person(hair, seed, options.gaussians))
        (out / f"{hair}.packed").write_bytes(pack(portable))
        exact, faces = runtime.Avatar(portable), []
        for number, names in enumerate(FACES[: options.faces]):
            eye, face = VIEWS[number % len(VIEWS)], placed(exact.pose(names))
            image, alpha = exact.render(face, camera_at(eye, side), background=BACKGROUND)
            entry = {"face": names, "eye": eye, "picture": write_picture(out / f"{hair}_{number}.png", image)}
            if number == 0:
                entry["alpha"] = write_picture(out / f"{hair}_alpha.png", alpha)
            faces.append(entry)
        told.append({"file": f"{hair}.packed", "faces": faces})
        if posed is None:
            pair = both(placed(exact.pose({})), placed(exact.pose({}), SECOND))
            image, _ = exact.render(pair, camera_at(VIEWS[0], side), background=BACKGROUND)
            posed = write_picture(out / "two.png", image)
    boxes = {name: {"place": place, "size": size} for name, (place, size) in BOXES.items()}
    least = {"face": 36, "two": 34, "box": 0.02}
    about = {"licence": "CC0-1.0", "side": side, "background": BACKGROUND, "fov": FOV, "target": TARGET, "least": least}
    two = {"place": SECOND, "eye": VIEWS[0], "picture": posed}
    (out / "set.json").write_text(
        json.dumps(about | {"boxes": boxes, "box_color": BOX_COLOR, "two": two, "avatars": told}, indent=1) + "\n"
    )


if __name__ == "__main__":
    main()
