"""The stages as the command line runs them: each reads its folders, skips what is current, writes its own folder."""

from mien.commands.stages.capturing import capture_stage
from mien.commands.stages.driving import DriveOptions, drive_stage
from mien.commands.stages.evaluating import evaluation_stage
from mien.commands.stages.face_models import add_face_model_stage, face_model_of
from mien.commands.stages.names import doubled_videos, run_name, sequence_name, sequence_names
from mien.commands.stages.tracking import tracking_stage
from mien.commands.stages.training import training_stage

__all__ = [
    "DriveOptions",
    "add_face_model_stage",
    "capture_stage",
    "doubled_videos",
    "drive_stage",
    "evaluation_stage",
    "face_model_of",
    "run_name",
    "sequence_name",
    "sequence_names",
    "tracking_stage",
    "training_stage",
]
