"""What training does with Gaussians that are bound to a surface, beside fitting pictures: it makes heads whole.

Sides that no picture shows are closed, hair moves, views from the side are compared with the completed mesh, and what
is inside a head explains only what the mesh shows of it. The trainer calls a `WholeHead` at its times.
"""

from collections.abc import Callable
from collections.abc import Sequence as Items
from dataclasses import dataclass, replace

from jaxtyping import Bool, Float
from torch import Tensor

from mien.avatar.avatar import Avatar, Posed
from mien.avatar.density import DensityControl
from mien.avatar.settings import Photometric, Progress
from mien.camera import Camera
from mien.face.params import FaceParams
from mien.face.torso import has_torso
from mien.gaussians import Rendering
from mien.machine.progress import say
from mien.training.footage.coverage import Coverage, measure_coverage
from mien.training.footage.filmed import with_shown_angles
from mien.training.footage.frames import COVER, SIDE_VIEW, BatchFrame, Footage, random_at
from mien.training.footage.hidden import inside_triangles
from mien.training.settings import TrainSettings
from mien.training.whole_head.contribution import prune_hidden
from mien.training.whole_head.hair_surface import HairSurface, hair_surface
from mien.training.whole_head.mouth_interior import cover_hidden, fill_interior, interior_colors
from mien.training.whole_head.rigid_parts import rigid_gaussians
from mien.training.whole_head.side_views import SideView, SideViews, side_views_of
from mien.training.whole_head.unseen import Unseen, fills_sides, spare_fills, unseen_of

HAIR_EVERY = 8  # number of training frames from one correction of the hair's surface to the next
_RIGID_TIMES = (0.35, 0.5, 0.65)
"""Times at which rigid parts are looked for, as fractions of the run. Before, shifts are hardly learned."""
_RIGID_VIEWS = 4  # one of so many views is looked at
_BOUND_EVERY = 250  # the same, from one time that Gaussians are bound anew to the next


@dataclass(frozen=True, eq=False)
class Prepared:
    """Facts that are found on the CPU before the avatar moves to its device, so that nothing has to come back."""

    side_views: SideViews | None
    """They stay on the CPU."""
    hair: HairSurface | None
    hideable: Bool[Tensor, " f"] | None
    """Triangles of which targets say whether the mesh hides them, on the CPU. None if nothing asks."""
    filled: int
    """Number of Gaussians that are filled rather than trained."""

    def to(self, like: Tensor) -> "Prepared":
        """The same for an avatar on the device of `like`."""
        views = self.side_views
        views = None if views is None else replace(views, held=views.compared.to(like.device))
        return replace(self, side_views=views, hair=None if self.hair is None else self.hair.to(like))


class WholeHead:
    """What no training picture shows of a head, what is inside of it, and what is done about both."""

    name = "hair"
    """Prefix of its tensors in checkpoints."""

    def __init__(
        self,
        avatar: Avatar,
        unseen: Unseen | None,
        settings: TrainSettings,
        interior: Float[Tensor, "f 3"] | None,
        coverage: Coverage | None,
        prepared: Prepared,
    ):
        """Take what the pictures show, and the colours of a mouth that is filled, on the device of the avatar.

        `unseen` is None if nothing is closed or limited, and `interior` if the mouth is not filled.
        """
        surface = avatar.extras.surface
        assert surface is not None
        self.unseen, self.coverage = unseen, coverage
        self.fills = unseen is not None and unseen.fills
        self.side_views, self.hair, self.hideable = prepared.side_views, prepared.hair, prepared.hideable
        self._filled = prepared.filled
        self._next_view: Callable[[], SideView] | None = None
        """Returns the side view of the step that runs. None if it has none."""
        self._begun_view: Callable[[], SideView] | None = None
        """On a GPU, returns the side view that was begun last."""
        self._avatar, self._surface, self._settings, self._interior = avatar, surface, settings, interior

    @property
    def rare_losses(self) -> tuple[str, ...]:
        """Names of losses that not every step has."""
        return () if self.side_views is None else ("side_views",)

    def density(self, control: DensityControl) -> DensityControl:
        """The avatar's density control, which spares what is closed."""
        return control if self.unseen is None else spare_fills(self._surface, control, self.unseen, self._filled)

    def weights(self, weights: Photometric) -> Photometric:
        """The weights of the losses that compare pictures."""
        return weights if self.unseen is None else self.unseen.weights(weights)

    def before_step(
        self, batch: Items[BatchFrame], meanwhile: Callable[[Callable[[], SideView]], Callable[[], SideView]]
    ) -> None:
        """Fill the mouth if it is due, and begin a side view if one of the frames is due for it.

        `meanwhile` lets another thread call a function, and returns what waits for its result.
        """
        if self._interior is not None:
            for one in batch:
                fill_interior(self._surface, self._avatar.face_model, self._interior, one.number, self._settings.steps)
        side_views, self._next_view = self.side_views, None
        due = [] if side_views is None else [one for one in batch if side_views.due(one.number)]
        if side_views is not None and due:
            one = due[0]
            random = random_at(self._settings.seed, SIDE_VIEW, one.number)
            if one.face.expression.is_cpu:
                self._next_view = meanwhile(side_views.drawn(one.face, one.camera, one.number, random))
                return
            # A worker waits for the GPU, so the view is that which was begun when the last one was due.
            assert self.unseen is not None
            height = self.unseen.prior.fill_height
            begun = meanwhile(side_views.fetched(one.face, one.camera_on_cpu, one.number, random, height))
            self._next_view, self._begun_view = self._begun_view or begun, begun

    @property
    def has_view(self) -> bool:
        """Whether the step that runs has a side view."""
        return self._next_view is not None

    def posed(self, posed: Posed, one: BatchFrame) -> Posed:
        """The Gaussians of a frame, of which those that the mesh hides have a colour drawn at random."""
        if self.hideable is None:
            return posed
        return cover_hidden(posed, self._surface, one.target.hidden, random_at(self._settings.seed, COVER, one.number))

    def losses(self, progress: Progress) -> dict[str, Float[Tensor, ""]]:
        """The loss of the side view, if the step has one."""
        side_views, view = self.side_views, self._next_view
        if side_views is None or view is None:
            return {}
        self._next_view = None
        return {"side_views": side_views.loss(self._avatar, view(), progress)}

    def after_backward(self, progress: Progress, renderings: Items[Rendering]) -> None:
        """Collect the gradients that move hair, and take those of what is made up."""
        if self.hair is not None:
            self.hair.collect(self._surface, progress.fraction)
        if self.unseen is not None:
            self.unseen.mask_gradients(self._avatar, self._surface, *renderings)

    def after_update(self, progress: Progress) -> None:
        """Bring Gaussians back to the surface. At times, bind them to what they lie on."""
        if self.unseen is not None:
            if progress.reaches(_BOUND_EVERY) and progress.done < progress.steps:
                self._surface.renew_binding(self.unseen.prior)
            self._surface.keep_to(self.unseen.prior)

    def move_hair(self, progress: Progress) -> None:
        """Correct the height of hair if it is due after a step."""
        hair = self.hair if progress.reaches(HAIR_EVERY) else None
        if hair and hair.correct(self._surface, progress.done / progress.steps, self._settings.hair_rate):
            self._follow_hair()

    def finds_rigid(self, progress: Progress) -> bool:
        """Whether this is a step after which rigid parts are looked for."""
        return progress.completes(round(time * progress.steps) for time in _RIGID_TIMES)

    def redundant(self, views: Items[tuple[FaceParams, Camera]], progress: Progress) -> Bool[Tensor, " n"]:
        """The Gaussians that hardly add to any of the views. Rigid parts change their binding before, if it is due."""
        assert self.unseen is not None
        prior, lost, faces = self.unseen.prior, None, [face for face, _ in views[::_RIGID_VIEWS]]
        if prior.carrier is not None and prior.closed is not None and self.finds_rigid(progress):
            rigid = rigid_gaussians(self._avatar, self._surface, faces, prior.closed)
            lost = self._surface.carry(rigid, prior) if len(rigid) else None
        last = progress.done >= progress.steps
        hidden = prune_hidden(self._avatar, self._surface, self.unseen, views, close=not last)
        return hidden if lost is None else hidden | lost

    def state(self) -> dict[str, Tensor]:
        """Tensors that a checkpoint has to save."""
        return {} if self.hair is None else self.hair.state

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        if self.hair is not None:
            self.hair.load_state(state)
            self._follow_hair()

    def _follow_hair(self) -> None:
        if self.hair is None or self.unseen is None:
            return
        prior = self.hair.prior()
        self.unseen = replace(self.unseen, prior=prior)
        if self.side_views is not None and prior.hair.is_cpu:
            self.side_views = self.side_views.at_height(prior.fill_height)


def prepare_whole_head(
    avatar: Avatar, footage: Footage, settings: TrainSettings
) -> Callable[[Tensor], WholeHead] | None:
    """Look at the training pictures, and close the avatar's surface where none shows it, if it is asked for.

    Returns a function that makes the whole head on the device of a tensor, once the avatar is there. It is None for
    avatars whose Gaussians are bound to no surface.
    """
    surface, model = avatar.extras.surface, avatar.face_model
    if surface is None:
        if has_torso(model):
            say(f"{model.name}: this method binds no Gaussians to the mesh, so the torso moves with the head")
        return None
    filled, unseen, coverage, interior = fills_sides(footage.frames, settings, bound=True), None, None, None
    if filled or surface.limited:
        unseen = unseen_of(avatar, footage, filled=filled)
        surface.close(unseen.prior)
        coverage = unseen.coverage
    if filled and coverage is not None:
        neutral = model.head_vertices(avatar.subject)[0].detach()
        assert avatar.filmed is not None
        avatar.filmed = with_shown_angles(avatar.filmed, model, neutral, coverage)
    if settings.inside == "filled":
        coverage = coverage or measure_coverage(footage)
        interior = interior_colors(avatar, coverage)

    prepared = _prepared(avatar, unseen, settings)

    def make(like: Tensor) -> WholeHead:
        own = None if unseen is None else unseen.to(like)
        inside = None if interior is None else interior.to(like)
        return WholeHead(avatar, own, settings, inside, coverage, prepared.to(like))

    return make


def _prepared(avatar: Avatar, unseen: Unseen | None, settings: TrainSettings) -> Prepared:
    model, surface, hair, filled = avatar.face_model, avatar.extras.surface, None, None
    if unseen is not None and surface is not None and unseen.fills:
        hair, filled = hair_surface(avatar, unseen.prior), unseen.filled_in(surface)
    views = side_views_of(model, avatar.subject, unseen, settings.side_weight)
    hideable = None if settings.inside == "free" else inside_triangles(model)
    return Prepared(views, hair, hideable, 0 if filled is None else int(filled.sum()))
