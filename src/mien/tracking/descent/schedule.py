"""The `paper` schedule: gradient descent over all frames in random order, which starts from the result of `fast`."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch

from mien.machine.progress import progress_bar
from mien.tracking.descent.epochs import Descent
from mien.tracking.descent.frames import fit_appearance, fit_sequence, measure_visibility, recenter
from mien.tracking.descent.scene import PaperScene, PaperState, first_state, paper_scene
from mien.tracking.fitting.fit import Course, Fit, Watch
from mien.tracking.fitting.resume import StageCache
from mien.tracking.fitting.shot import Shot
from mien.tracking.landmarks.model import LandmarkModel
from mien.tracking.pixels.texture import PhotometricFit, SkinTexture, texture_space
from mien.tracking.settings import TrackingSettings


def fit_by_descent(
    model: LandmarkModel,
    shots: Sequence[Shot],
    lenses: Sequence[int | None],
    fit: Fit,
    settings: TrackingSettings,
    cache: StageCache,
    watch: Watch,
    refined: PhotometricFit | None = None,
) -> PhotometricFit:
    """Refine a fit as in the supplement of GaussianAvatars, section A.

    If the fit was already fitted to pixels, only the global epochs run. Otherwise the pass along the frames runs first.
    A frame whose landmarks get lost in that pass keeps its fit to landmarks and is not `improved`.

    Args:
        model: The face model reduced to its landmarks.
        shots: The sequences.
        lenses: Index of each sequence's unknown focal length (`lenses_of`).
        fit: The fit to landmarks, or that of the schedule `fast`.
        settings: Settings of the whole tracking.
        cache: Keeps the state from which an interrupted fit of the same input resumes.
        watch: Receives the progress.
        refined: `fit` with texture and light, if it was fitted to pixels.
    """
    if refined is not None and not (refined.texture.trust > 0).any():
        return refined  # The pictures show nothing to fit to.
    scene = paper_scene(model, shots, lenses, fit, settings, refined)
    descent = Descent(scene, first_state(scene, fit, lenses, refined))
    descent.resume(cache)
    if refined is not None:
        descent.done = max(descent.done, descent.frames)
    total = descent.frames * (1 + settings.paper.epochs)

    def outcome() -> PhotometricFit:
        return _as_photometric(scene, descent, fit, refined)

    with torch.enable_grad(), progress_bar("Refining by descent", total, min(descent.done, total)) as bar:
        course = Course("pixels", total, bar, watch, min(descent.done, total))
        advance = partial(course.advance, current=outcome)
        for sequence in range(len(shots) if refined is None else 0):
            fit_sequence(descent, sequence, advance, cache)
        if descent.done == descent.frames:
            measure_visibility(descent) if refined is not None else recenter(descent)
            fit_appearance(descent)
        for epoch in range(settings.paper.epochs):
            descent.fit_epoch(epoch, advance, cache)
    return outcome()


def follow_by_descent(
    model: LandmarkModel,
    shots: Sequence[Shot],
    start: PhotometricFit,
    known: PhotometricFit,
    settings: TrackingSettings,
    cache: StageCache,
    watch: Watch,
) -> PhotometricFit:
    """Run the schedule for the motion of sequences alone. Subject, cameras, texture and light stay as they are.

    The pass along the frames runs if the settings start from landmarks, each frame from its own.

    Args:
        model: The face model reduced to its landmarks.
        shots: The sequences.
        start: Their fit so far, with the cameras and lights to keep. The bias of its subject is without the effect of
            vertex offsets.
        known: The result of `fit_by_descent` for other sequences of the person: subject and texture.
        settings: Settings of the whole tracking.
        cache: Keeps the state from which an interrupted fit of the same input resumes.
        watch: Receives the progress.
    """
    rates = replace(settings.paper.rates, identity=0.0, offsets=0.0, texture=0.0, light=0.0, focal=0.0)
    still = replace(settings, paper=replace(settings.paper, rates=rates))
    person, lenses = known.fit.subject, [None] * len(shots)
    fit = replace(start.fit, subject=replace(start.fit.subject, identity=person.identity))
    shown = replace(start, fit=fit, texture=known.texture)
    scene = paper_scene(model, shots, lenses, fit, still, shown)
    state = first_state(scene, fit, lenses, shown)
    state.visibility = torch.ones_like(state.visibility)  # The trust of the known texture is in the scene's weights.
    if person.vertex_offsets is not None:
        state.offsets = person.vertex_offsets.clone()
    descent = Descent(scene, state)
    descent.resume(cache)
    if settings.paper.start != "landmarks":
        descent.done = max(descent.done, descent.frames)
    total = descent.frames * (1 + settings.paper.epochs)

    def outcome() -> PhotometricFit:
        moved = _as_photometric(scene, descent, fit, shown)
        return replace(moved, fit=replace(moved.fit, subject=person), texture=known.texture, lights=start.lights)

    title = "Refining held-out sequences by descent"
    with torch.enable_grad(), progress_bar(title, total, min(descent.done, total)) as bar:
        advance = partial(Course("pixels", total, bar, watch, min(descent.done, total)).advance, current=outcome)
        for sequence in range(len(shots)):
            fit_sequence(descent, sequence, advance, cache, known_person=True)
        for epoch in range(settings.paper.epochs):
            descent.fit_epoch(epoch, advance, cache)
    return outcome()


def _as_photometric(scene: PaperScene, descent: Descent, fit: Fit, refined: PhotometricFit | None) -> PhotometricFit:
    """The fit with texture and light. Each texel has the trust of its triangle."""
    state, fit = descent.state, _as_fit(scene, descent.state, fit)
    fragments = texture_space(scene.face_model, scene.settings.texture_size).fragments
    trust = torch.cat([descent.trusted(), torch.zeros(1)])[fragments.face_index.long()]
    improved = [torch.ones(len(rows), dtype=torch.bool) for rows in state.frames]
    if refined is not None:
        improved = [own.clone() for own in refined.improved]
    for sequence, row in descent.lost:
        improved[sequence][row] = False
    appearance = SkinTexture(state.texture, trust, scene.settings.color_epsilon)
    return PhotometricFit(fit, appearance, tuple(state.lights), tuple(improved))


def _as_fit(scene: PaperScene, state: PaperState, fit: Fit) -> Fit:
    """The state as a fit to landmarks. The effect of the offsets on landmarks is added to the bias."""
    with torch.no_grad():
        offsets = state.offsets if scene.settings.offset_sigma > 0 else None
        moved = scene.landmarks.positions(state.offsets, scene.mesh.faces).double()
    subject = replace(
        fit.subject, identity=state.identity.double(), bias=fit.subject.bias + moved, vertex_offsets=offsets
    )
    sequences = []
    for own, was, rows in zip(scene.sequences, fit.sequences, state.frames, strict=True):
        factor = 1.0 if own.lens is None else float(state.log_focals[own.lens].exp())
        sequences.append(replace(was, cameras=was.cameras.with_focal(factor), state=rows.double()))
    return Fit(subject, tuple(sequences))
