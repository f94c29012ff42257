"""Make faults by kind of file: each changes the copies of a case before they are read."""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from random import Random

from damage import flip_or_cut
from fuzzing import place_faults
from fuzzing.archive_faults import faulty_npz, faulty_pickle
from fuzzing.box_faults import faulty_mp4, faulty_stream
from fuzzing.edges import CANARY, PORT
from fuzzing.export_faults import EXPORT_FAULTS
from fuzzing.json_faults import faulty_json, faulty_text, written
from fuzzing.picture_faults import faulty_picture
from fuzzing.repairs import repair_around, repair_portable, repair_tensors, with_checksum
from fuzzing.tensor_faults import faulty_tensors, split
from fuzzing.text_faults import faulty_ply, faulty_table, playlist

DAMAGE = "damage"
"""Name of the faults that a checksum must notice."""
_REPAIRED, _WITHOUT = 0.75, 0.9
"""Shares of faulty json files with a corrected checksum, and with a corrected checksum or none."""


@dataclass
class Place:
    """Folder and file of a case. `file` changes if the file is renamed."""

    root: Path
    """Folder with the copies."""
    file: Path
    canary: Path
    """Folder outside of the copies, into which nothing may be written."""
    port: int
    """Port of this machine to which nothing may connect."""

    def filled(self, data: bytes) -> bytes:
        """Return the bytes with the placeholders of folder and port replaced."""
        return data.replace(CANARY.encode(), os.fsencode(self.canary)).replace(PORT.encode(), str(self.port).encode())


def faulty_file(place: Place, dice: Random) -> str:
    """Damage a file, put something else in its place, or make a fault of its format with correct checksums."""
    chance = dice.random()
    if chance < 0.12:
        place.file.write_bytes(flip_or_cut(place.file.read_bytes(), dice))
        return DAMAGE
    if chance < 0.22:
        return faulty_place(place, dice)
    return faulty_format(place, dice)


def faulty_content(place: Place, dice: Random) -> str:
    """Damage a file, or make a fault of its format, for readers that get the bytes and not the place."""
    if dice.random() < 0.15:
        place.file.write_bytes(flip_or_cut(place.file.read_bytes(), dice))
        return DAMAGE
    return faulty_inside(place, dice) if place.file.suffix == ".mien" else faulty_format(place, dice)


def faulty_without_damage(place: Place, dice: Random) -> str:
    """Make a fault as `faulty_file` does, but no unrepaired damage, for files that may also be read from elsewhere."""
    return faulty_place(place, dice) if dice.random() < 0.5 else faulty_format(place, dice)


def faulty_place(place: Place, dice: Random) -> str:
    """Put something else where the file is."""
    return "place: " + place_faults.faulty_place(place.file, place.canary, dice)


def any_fault(place: Place, dice: Random) -> str:
    """Make any fault."""
    return faulty_place(place, dice) if place.file.is_dir() or dice.random() < 0.4 else faulty_format(place, dice)


def faulty_format(place: Place, dice: Random) -> str:
    """Make a fault of the file's own format."""
    if place.file.suffix == ".partial":
        return faulty_lines(place, dice)
    data, suffix = place.file.read_bytes(), place.file.suffix
    if suffix == ".json":
        kind, data = _faulty_json_file(data, dice)
    elif suffix == ".safetensors":
        kind, data = faulty_tensors(data, dice)
        data = repair_tensors(data)
    else:
        kind, data = _BY_ENDING.get(suffix, faulty_stream)(data, dice)
    place.file.write_bytes(place.filled(data))
    repair_around(place.file)
    return kind


def faulty_new_name(place: Place, dice: Random) -> str:
    """Make a fault, and give the file a name of its own: USD keeps stages by their names."""
    kind = faulty_file(place, dice)
    if place.file.is_file() and not place.file.is_symlink():
        place.file = place.file.rename(place.file.with_stem(f"{dice.getrandbits(60):x}"))
    return kind


def faulty_portable(place: Place, dice: Random) -> str:
    """Damage a .mien file, put something else in its place, or make a fault in it."""
    return faulty_file(place, dice) if dice.random() < 0.25 else faulty_inside(place, dice)


def faulty_inside(place: Place, dice: Random) -> str:
    """Make a fault in a .mien file: in its arrays, in its content, or in the entry around the content."""
    data = place.file.read_bytes()
    if dice.random() < 0.5:
        kind, data = faulty_tensors(data, dice)
        data = repair_portable(data)
    else:
        content = json.loads(split(data)[0]["__metadata__"]["mien"])["content"]
        kind, content = faulty_json(content, dice)
        kind, data = f"content {kind}", repair_portable(data, content)
    place.file.write_bytes(place.filled(data))
    return kind


def _faulty_json_file(data: bytes, dice: Random) -> tuple[str, bytes]:
    if dice.random() < 0.12:
        kind, data = faulty_text(data, dice)
        return f"text {kind}", data
    content = json.loads(data)
    if not isinstance(content, dict):
        kind, content = faulty_json(content, dice)
        return kind, written(content, dice)
    checksum = content.pop("checksum", None)
    frame = (
        {name: content.pop(name) for name in ("format", "version") if name in content} if dice.random() < 0.8 else {}
    )
    kind, content = faulty_json(content, dice)
    if isinstance(content, dict):
        content = {**frame, **content}
        chance = dice.random()
        if checksum is not None and chance < _REPAIRED:
            content = with_checksum(content)
        elif checksum is not None and chance > _WITHOUT:
            content["checksum"] = checksum
    return kind, written(content, dice)


def faulty_lines(place: Place, dice: Random) -> str:
    """Make a fault in one of the json lines of a file, or in its place."""
    if dice.random() < 0.2:
        return faulty_place(place, dice)
    lines = place.file.read_bytes().splitlines()
    index = dice.randrange(len(lines)) if dice.random() < 0.2 else len(lines) - 1
    if dice.random() < 0.8:
        kind, content = faulty_json(json.loads(lines[index]), dice)
        lines[index] = written(content, dice).replace(b"\n", b" ")
    else:
        kind, lines[index] = faulty_text(lines[index], dice)
    if dice.random() < 0.2:
        lines += [lines[index]] * dice.choice((1, 1000))
    place.file.write_bytes(place.filled(b"\n".join(lines) + dice.choice((b"\n", b"\n", b""))))
    return kind


def write_playlist(place: Place, dice: Random) -> str:
    """Write a list of other files under a video's name."""
    kind, ending, data = playlist("clip.mp4", dice)
    clip = place.canary / "clip.mp4"
    if not clip.exists():
        clip.write_bytes(place.file.read_bytes())
    place.file = place.file.with_name(f"list{ending}")
    place.file.write_bytes(place.filled(data))
    return kind


def rename(place: Place, dice: Random) -> str:
    """Give the file an odd name."""
    place.file = place_faults.rename_oddly(place.file, dice, place.port)
    return ascii(place.file.stem)[:30]


_BY_ENDING = {
    ".png": faulty_picture, ".jpg": faulty_picture, ".webp": faulty_picture, ".tif": faulty_picture,
    ".bmp": faulty_picture,
    ".mp4": faulty_mp4, ".mov": faulty_mp4, ".csv": faulty_table, ".ply": faulty_ply, ".npz": faulty_npz,
    ".pkl": faulty_pickle, **EXPORT_FAULTS, ".m4a": faulty_mp4,
}  # fmt: skip
