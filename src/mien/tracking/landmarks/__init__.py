"""The fit to landmarks: the response of the detector, the cost of landmarks, and the stages of the fit."""

from mien.tracking.landmarks.detector_response import DetectorResponse, read_response, response_path, write_response
from mien.tracking.landmarks.embedding import EmbeddingSettings, embed_landmarks
from mien.tracking.landmarks.groups import (
    BROWS,
    EYE_CORNERS,
    LEFT_EYELIDS,
    LEFT_IRIS,
    LEFT_LID_PAIRS,
    LIPS,
    NOSE,
    OVAL,
    RIGHT_EYELIDS,
    RIGHT_IRIS,
    RIGHT_LID_PAIRS,
    landmark_weights,
)
from mien.tracking.landmarks.model import LandmarkModel, reduce_face_model
from mien.tracking.landmarks.outcome import as_tracking
from mien.tracking.landmarks.regions import with_regions_by_landmarks
from mien.tracking.landmarks.shared_fit import fit_bias
from mien.tracking.landmarks.stages import fit_landmarks, follow_landmarks
from mien.tracking.landmarks.term import LandmarkTerm, all_landmarks, move_subject, quiet_landmarks
from mien.tracking.landmarks.turn_habits import without_turn_habits

__all__ = [
    "BROWS",
    "DetectorResponse",
    "EYE_CORNERS",
    "EmbeddingSettings",
    "LEFT_EYELIDS",
    "LEFT_IRIS",
    "LEFT_LID_PAIRS",
    "LIPS",
    "LandmarkModel",
    "LandmarkTerm",
    "NOSE",
    "OVAL",
    "RIGHT_EYELIDS",
    "RIGHT_IRIS",
    "RIGHT_LID_PAIRS",
    "all_landmarks",
    "as_tracking",
    "embed_landmarks",
    "fit_bias",
    "fit_landmarks",
    "landmark_weights",
    "follow_landmarks",
    "move_subject",
    "quiet_landmarks",
    "read_response",
    "reduce_face_model",
    "response_path",
    "with_regions_by_landmarks",
    "without_turn_habits",
    "write_response",
]
