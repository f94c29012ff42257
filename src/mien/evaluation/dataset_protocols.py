"""Protocols of datasets: the frames, pixels and metrics that their authors score, as far as these are published."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mien.errors import UserError
from mien.evaluation.metrics import Border
from mien.evaluation.scoring import ScoreSettings, lpips_metric
from mien.tracking.scoring import Scoring
from mien.training.footage.frames import Frame
from mien.training.footage.sequence import Sequence
from mien.training.settings.splits import BENCHMARK_SPLIT, NAMED_SPLIT, OWN_SPLIT, TEST_CAMERAS, imported_from

_ALEX, _VGG = "lpips-alex", "lpips-vgg"


@dataclass(frozen=True)
class DatasetProtocol:
    """One way to score a run on an imported dataset. Pictures are over white, with colours as filmed."""

    name: str
    datasets: tuple[str, ...]
    """Datasets whose sequences are scored so, by their names for `mien import`."""
    splits: tuple[str, ...] = (OWN_SPLIT,)
    """Splits that the run may be trained with."""
    border: Border = "zeros"
    """This says which windows of SSIM count at the border of a picture."""
    lpips: tuple[str, ...] = (_ALEX, _VGG)
    """Trunks with which LPIPS is reported. Both, if papers differ or say nothing."""
    opened: bool = False
    """Whether the authors erode and dilate their drawings, and score a second time without clothes. Both are further
    figures, beside those of the drawings as they are."""
    cut_at_line: tuple[str, ...] = ()
    """Those of the datasets that have no mattes of the head. Their pictures are cut at GaussianAvatars' neck line."""


DATASET_PROTOCOLS = (
    DatasetProtocol("insta", ("insta",), lpips=(_VGG,)),
    DatasetProtocol("imavatar", ("imavatar",), border="inside", lpips=(_ALEX,), opened=True),
    DatasetProtocol("nersemble", ("vhap", "nersemble"), (NAMED_SPLIT, OWN_SPLIT), cut_at_line=("nersemble",)),
    DatasetProtocol(BENCHMARK_SPLIT, ("nersemble-benchmark", "nersemble", "vhap"), (BENCHMARK_SPLIT, OWN_SPLIT)),
    DatasetProtocol("vhap", ("vhap",)),
    DatasetProtocol("nerface", ("nerface",)),
    DatasetProtocol("nerf-blendshape", ("nerf-blendshape",)),
)
"""`insta` is that of RGBAvatar, `imavatar` that of MonoGaussianAvatar, `nersemble` that of GaussianAvatars."""


def dataset_protocol(name: str) -> DatasetProtocol:
    """Return a protocol by its name."""
    return next(each for each in DATASET_PROTOCOLS if each.name == name)


def check_lpips(protocol: DatasetProtocol, settings: ScoreSettings) -> None:
    """Check that exact LPIPS, if it is asked for, is that of the protocol."""
    metric = lpips_metric(settings)
    if metric is not None and metric.backbone not in protocol.lpips:
        raise UserError(
            f"--lpips-weights {settings.lpips_weights}: gives {metric.backbone}, and --protocol {protocol.name} "
            f"reports {' or '.join(protocol.lpips)}; give the other file, or leave --protocol out"
        )


def scores_whole_mattes(protocol: DatasetProtocol, run_dir: Path, folders: Mapping[Path, Scoring], split: str) -> bool:
    """Check that a protocol fits a run, and return whether it scores whole mattes instead of mien's scoring masks.

    `folders` are those of the run's sequences, with their scoring masks.
    """
    found = {folder: imported_from(folder) for folder in folders}
    for folder, dataset in found.items():
        if dataset not in protocol.datasets:
            told = "was not imported" if dataset is None else f"was imported from {dataset}"
            raise UserError(f"{folder}: {told}; leave --protocol {protocol.name} out, or give the dataset's own name")
    if split not in protocol.splits:
        raise UserError(
            f"{run_dir}: was trained with --split {split}, and --protocol {protocol.name} needs the split of the "
            f"dataset; train another run with --split {' or '.join(protocol.splits)}"
        )
    cut = [folder for folder, dataset in found.items() if dataset in protocol.cut_at_line]
    for folder in cut:
        if folders[folder].cut != "line":
            raise UserError(
                f"{folder}: its scoring masks are cut at a plane, and --protocol {protocol.name} cuts at the neck "
                f"line; delete {folder / 'scoring'} and run `mien track` with --scoring.cut line"
            )
    if cut and len(cut) < len(found):
        other = next(folder for folder in found if folder not in cut)
        raise UserError(
            f"{run_dir}: was trained on {found[cut[0]]} and {found[other]}, whose pixels are not scored alike; train "
            "on one of them"
        )
    return not cut


def counted_frames(
    sequences: tuple[Sequence, ...], split: str, found: Mapping[str, tuple[str, tuple[Frame, ...]]]
) -> dict[str, tuple[str, tuple[Frame, ...]]]:
    """Those held-out frames that count. The monocular benchmark tests whole sequences, seen from four cameras."""
    whole = "self_reenactment_sequence"
    if split != BENCHMARK_SPLIT or whole not in found:
        return dict(found)
    name, frames = found[whole]
    tested = tuple(
        frame for frame in frames if sequences[frame.sequence].capture.camera_ids[frame.camera] in TEST_CAMERAS
    )
    return {whole: (name, tested)}
