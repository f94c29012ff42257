"""Whole heads as a part of a training: closed sides, hair that moves, and views from the side."""

from collections.abc import Callable
from collections.abc import Sequence as Items
from dataclasses import replace

from jaxtyping import Bool, Float
from torch import Tensor

from mien.avatar.avatar import Avatar
from mien.avatar.bound_surface import BoundSurface
from mien.render.rendering import Rendering
from mien.training.footage.filmed import with_shown_angles
from mien.training.footage.frames import resolved, side_random
from mien.training.parts import Preparation, Step, TrainingPart
from mien.training.settings import TrainSettings
from mien.training.whole_head.contribution import prune_hidden
from mien.training.whole_head.hair_surface import HairSurface, hair_surface
from mien.training.whole_head.side_views import SideView, SideViews, side_views_of
from mien.training.whole_head.unseen import Unseen, fills_sides, moved, spare_fills, unseen_of

HAIR_EVERY = 8  # number of training frames from one correction of the hair's surface to the next


class WholeHead:
    """What no training picture shows, and what is done about it.

    Args:
        avatar: The avatar, on its device.
        unseen: What the training pictures show, on the same device.
        settings: The settings of the run.
    """

    def __init__(self, avatar: Avatar, unseen: Unseen, settings: TrainSettings):
        self.unseen = unseen
        self.side_views: SideViews | None = side_views_of(avatar, unseen, settings.side_weight)
        self.hair: HairSurface | None = hair_surface(avatar, unseen.prior) if unseen.fills else None
        self._next_view: Callable[[], SideView] | None = None
        """Returns the side view of the step that runs. None if it has none."""
        self._avatar = avatar
        self._surface: BoundSurface | None = avatar.surface()

    def part(self) -> TrainingPart:
        """The functions that the trainer calls."""
        return TrainingPart(
            "hair",
            settings=lambda settings: resolved(settings, filled=True) if self.unseen.fills else settings,
            density=lambda control: spare_fills(self._avatar, control, self.unseen),
            weights=lambda weights: self.unseen.weights(weights),
            before_step=self._before_step,
            losses=self._losses,
            rare_losses=() if self.side_views is None else ("side_views",),
            after_backward=self._after_backward,
            after_update=self._after_update,
            after_step=self._after_step,
            state=lambda: {} if self.hair is None else self.hair.state,
            load_state=self._load_state,
        )

    def follow_hair(self) -> None:
        """Let what is known of the surface follow the hair."""
        if self.hair is None:
            return
        prior = self.hair.prior()
        self.unseen = replace(self.unseen, prior=prior)
        if self.side_views is not None:
            self.side_views = self.side_views.at_height(prior.fill_height)

    def _before_step(self, step: Step) -> None:
        """Begin a side view if one of the frames is due for it: that of the first such frame."""
        side_views, self._next_view = self.side_views, None
        due = [] if side_views is None else [one for one in step.batch if side_views.due(one.number)]
        if side_views is not None and due:
            one = due[0]
            random, face = side_random(step.settings, one.number), step.track.face(one.index)
            self._next_view = step.meanwhile(side_views.drawn(face, one.camera, one.number, random))

    def _losses(self, step: Step) -> dict[str, Float[Tensor, ""]]:
        """The loss of the side view, if the step has one."""
        side_views, view = self.side_views, self._next_view
        if side_views is None or view is None:
            return {}
        self._next_view = None
        return {"side_views": side_views.loss(step.avatar, view(), step.progress)}

    def _after_backward(self, step: Step, renderings: Items[Rendering]) -> None:
        if self.hair is not None and self._surface is not None:
            self.hair.collect(self._surface, step.progress.step / step.settings.steps)
        self.unseen.mask_gradients(step.avatar, *renderings)

    def _after_update(self, step: Step) -> None:
        if self._surface is not None:
            self._surface.keep_to(self.unseen.prior)

    def _after_step(self, step: Step) -> None:
        hair, surface = self.hair if step.reaches(HAIR_EVERY) else None, self._surface
        if hair and surface and hair.correct(surface, step.fraction_done, step.settings.hair_rate):
            self.follow_hair()
        self._prune_hidden(step)

    def _prune_hidden(self, step: Step) -> None:
        """Remove Gaussians that pictures do not show, after a round of density control and at the end."""
        last = step.fraction_done >= 1
        if not self.unseen.fills or not (step.changed or last) or not step.representative:
            return

        def redundant() -> Bool[Tensor, " n"]:
            track = step.track
            views = [
                (track.face(track.index_of(frame.sequence, frame.timestep)).detach(), step.camera(frame))
                for frame in step.representative
            ]
            return prune_hidden(step.avatar, self.unseen, views, close=not last)

        step.density.thin(step.avatar.gaussian_store(), redundant)

    def _load_state(self, state: dict[str, Tensor]) -> None:
        if self.hair is not None:
            self.hair.load_state(state)
            self.follow_hair()


def prepare_whole_head(given: Preparation) -> Callable[[], WholeHead] | None:
    """Close the avatar's surface where no picture shows it, if it is asked for.

    Returns:
        A function that makes the whole head once the avatar is on its device, or None.
    """
    avatar, surface = given.avatar, given.avatar.surface()
    filled = fills_sides(given.frames, given.settings, bound=surface is not None)
    if not filled and (surface is None or not surface.limited):
        return None
    unseen = unseen_of(avatar, given.sequences, given.faces, given.frames, filled=filled)
    if surface is not None:
        surface.close(unseen.prior)
    if unseen.coverage is not None:
        given.known_coverage = unseen.coverage
        neutral = given.face_model.head_vertices(avatar.subject)[0].detach()
        assert avatar.filmed is not None
        avatar.filmed = with_shown_angles(avatar.filmed, given.face_model, neutral, unseen.coverage)
    return lambda: WholeHead(avatar, moved(unseen, given.like), given.settings)
