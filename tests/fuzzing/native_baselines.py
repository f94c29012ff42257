"""Make a valid call of every native function, small and random. `native_calls.py` mutates it, and tests break it.

Arrays are given by words: `"n 3"` is of normal numbers, `"+n 3"` of positive ones, `"%n 3"` of numbers from 0 to 1,
`"=n 3"` of zeros to be filled, and `"<v n 3"` of integers below v. `"?n 3"` is None half the time, and `:i4` gives a
type. A letter is a length that holds for the whole call. `h^` is rounded up to 16, and `3?` is left out at times."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

Rng = np.random.Generator
Arguments = list[Any]
F32 = np.float32
FEW = (1, 2, 5, 16, 17, 40)
SIZES = {
    "H": (1, 3, 8, 33, 64), "G": (1, 3, 8, 33, 64), "W": (6, 7, 16, 31, 65), "U": (6, 7, 16, 31, 65),
    "v": (3, 15, 16, 50), "V": (3, 4, 7, 18, 19, 42), "g": (0, 1, 5, 17, 300), "q": (1, 4, 9, 16), "3?": (0, 3),
    **{name: range(0, 4) for name in ("j", "B", "u")}, "k": range(0, 5), "e": range(0, 6),
    "a": range(1, 3), "b": range(1, 4), "d": range(1, 4), "c": range(1, 5), "p": range(1, 6), "K": range(1, 7),
    "r": range(1, 9), **{name: range(1, 20) for name in ("f", "x", "h")}, "o": range(0, 19),
}  # fmt: skip
"""Lengths by letter; others are of FEW."""


class Call:
    """The parts of the arguments of one call. Named tuples and classes of the core take words for their arrays."""

    def __init__(self, native: Any, rng: Rng) -> None:
        self.native, self.rng = native, rng
        self.sizes: dict[str, int] = {}

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return lambda *given: getattr(self.native, name)(*self.given(*given))

    def given(self, *given: Any) -> Arguments:
        """Return values, with arrays in the place of words."""
        return [self.array(one) if isinstance(one, str) else one for one in given]

    def size(self, word: str) -> int:
        """Return a length."""
        if word[-1] == "^":
            return -(-self.size(word[:-1]) // 16) * 16
        for sign, join in (("+", sum), ("*", math.prod)):
            if sign in word:
                return join(map(self.size, word.split(sign)))
        if word.isdigit():
            return int(word)
        if word not in self.sizes:
            self.sizes[word] = int(self.rng.choice(SIZES.get(word, FEW)))
        return self.sizes[word]

    def array(self, text: str) -> Any:
        """Return the array that words describe."""
        if text[0] == "?":
            return self.maybe(self.array(text[1:]))
        kind = text[0] if text[0] in "=+%<" else ""
        words, _, dtype = text.removeprefix(kind).partition(":")
        names = words.split()
        most = self.size(names.pop(0)) if kind == "<" else 0
        shape = [self.size(word) for word in names if word != "3?" or self.size(word)]
        if kind == "=":
            return np.zeros(shape, dtype or F32)
        if kind == "<":
            return self.rng.integers(0, most, shape).astype(dtype or np.int64)
        numbers = self.rng.random(shape) if kind == "%" else self.rng.standard_normal(shape)
        return (np.abs(numbers) if kind == "+" else numbers).astype(F32)

    def flag(self, share: float = 0.5) -> bool:
        return bool(self.rng.random() < share)

    def maybe(self, value: Any, share: float = 0.5) -> Any:
        return value if self.flag(share) else None

    def picture(self) -> tuple[int, int]:
        return self.size("H"), self.size("W")

    def box(self) -> list[int]:
        """Return left, top, width and height of a part of the picture."""
        h, w = self.picture()
        left, top = int(self.rng.integers(0, w)), int(self.rng.integers(0, h))
        return [left, top, int(self.rng.integers(0, w - left + 1)), int(self.rng.integers(0, h - top + 1))]

    def camera(self) -> tuple[np.ndarray, np.ndarray]:
        """Return K and viewmat of a camera 3 units in front of the origin."""
        h, w = self.picture()
        viewmat = np.diag([1, -1, -1, 1]).astype(F32)
        viewmat[2, 3] = 3
        return np.array([[w, 0, w / 2], [0, w, h / 2], [0, 0, 1]], F32), viewmat


# Blended features and points


def network(c: Call, rows: str = "?<a n") -> Arguments:
    bases = c.FeatureBases("n k f", "a k", c.array(rows) if rows else None)
    return [c.FeatureNetwork("n f", "n x", "h f+x", "h", "o+1 h", "o+1"), bases]


def feature_network_backward(c: Call) -> Arguments:
    """Return inputs with rows or with a gradient."""
    wanted = c.flag()
    gradients = "n o", "n", "=n f", "=h f+x", "=h", "=o+1 h", "=o+1", "=k" if wanted else "=0"
    kept = c.FeatureKept("n f", "n h^")
    return [*network(c, "" if wanted else "<a n"), kept, c.FeatureGradients(*gradients, "=n x" if c.flag() else "=0 0")]


def factored(c: Call, *others: Any) -> Arguments:
    terms = range(c.size("u"))
    lists = [[c.array(words) for _ in terms] for words in ("n f", "a k", "?<a n")]
    return c.given("n k f", *lists, *others, 0.01)


def point_layers(c: Call) -> Arguments:
    """Return the layers and their inputs. Letters of lengths: `i` inputs, `l` outputs, `y` what is kept."""
    widths, layers = [int(c.rng.integers(1, 20))], []
    for index in range(int(c.rng.integers(1, 5))):
        extra = int(c.rng.integers(-1, index)) if index > 0 else -1
        reads = widths[-1] + (widths[extra] if extra >= 0 else 0)
        widths.append(int(c.rng.integers(1, 40)))
        shapes = f"{widths[-1]} {reads}", f"{widths[-1]}"
        layers.append([*c.given(*shapes), int(c.rng.integers(0, 3)), extra])
    layers[-1][2] = 0
    c.sizes |= {"i": widths[0], "l": widths[-1], "y": sum(-(-width // 16) * 16 for width in widths[1:-1])}
    return [[c.PointLayer(*layer) for layer in layers], c.array("n i")]


def point_network_backward(c: Call) -> Arguments:
    layers, inputs = point_layers(c)
    gradients = [c.PointLayerGradients(*(np.zeros_like(array) for array in layer[:2])) for layer in layers]
    return c.given(layers, inputs, "n y", "n l", gradients, "?=n i")


def skinned(c: Call) -> Any:
    return c.SkinPoints("n 3", "B n 3", "n K", "K 3 4", "B K 3 4")


# Faces and rigs


def make_face_model(c: Call) -> Arguments:
    """Letters of lengths: `v` vertices, `e` expressions, `j` free joints (the first joint is not free)."""
    joints = range(c.size("j+1"))
    parents = [int(c.rng.integers(-1, joint)) if joint else -1 for joint in joints]
    return c.given("e v 3", "?9*j v 3", "e j+1 3", "e j+1 3", "+v j+1", parents, [joint > 0 for joint in joints])


def posing(c: Call) -> Arguments:
    head = ("b 3", "b 3") if c.flag(0.7) else (None, None)
    return [c.make_face_model(*make_face_model(c)), c.FaceArrays("v 3", "j+1 3", "b e", "b j 3", *head)]


def rig_forward(c: Call) -> Arguments:
    world = c.WorldShapes("=a n 3", "=a n 4", "=a n 3")
    return c.given("a v 3", "<v t 3", "<t n", c.LocalShapes("n 3", "n 4", "n 3"), "=a t 20", world)


def rig_backward(c: Call) -> Arguments:
    vertices, faces, face_index, local, frames, posed = rig_forward(c)
    c.native.rig_forward(vertices, faces, face_index, local, frames, posed)
    topology = c.make_rig_topology(c.size("v"), faces, face_index)
    outputs = c.LocalShapes("=n 3", "=n 4", "=n 3"), "=a v 3"
    by_world = c.WorldShapes("a n 3", "a n 4", "a n 3")
    return c.given(topology, vertices, local, frames, posed.scales, by_world, *outputs)


def face_activations(c: Call) -> Arguments:
    """Return the arrays of `make_face_activations`, for j coefficients and one joint."""
    shares = c.maybe(c.array("t a"))
    regions = 1 if shares is None else c.size("a")
    own = [c.array("j+3"), *(c.array(f"{rows} {regions}*r") for rows in ("j+3", "k"))]
    return [*own, shares, *(c.maybe(c.given("6", "6 p", "k p"), 0.7) or [None] * 3)]


def ride(c: Call) -> Arguments:
    topology = c.make_rig_topology(c.size("v"), "<v t 3", "<t n")
    face = c.FaceArrays("v 3", "j+1 3", "1 e", "1 j 3", "1 3", "1 3")
    posed = c.PosedGaussians("=n 3", "=n 4", "=n 3", "=n", "=4 4")
    local = c.LocalGaussians("n 3", "n 4", "n 3", "n")
    model, changed = c.make_face_model(*make_face_model(c)), c.maybe(changes(c))
    return [model, topology, c.flag(), face, local, posed, *(changed or [])]


def changes(c: Call) -> Arguments:
    """Return what changes the Gaussians of a ride, the arrays that are filled, and weights."""
    offset, color, opacity, features = (c.flag() for _ in range(4))
    kinds = [("n 3 r", "n 3", offset), ("n 3 r", "n 3", color), ("n r", "n", opacity)]
    network = ["n f", "n r+a f", "h f", "4 h"] if features else [None] * 4
    of_features = ["=n 3", "=n"] if features else [None] * 2
    arrays = c.ChangeArrays("n 1 3", "t r+a", *(basis if there else None for basis, _, there in kinds), *network)
    found = ("=" + change if there else None for _, change, there in kinds)
    return [arrays, c.ChangedArrays("=n 1 3", *found, *of_features, "=", "="), (3.0, 0.1)]


def ride_changes_backward(c: Call) -> Arguments:
    given, (arrays, changed, weights) = ride(c)[:6], changes(c)
    own = c.native.ride(*given, arrays, changed, weights)
    shapes = ("n 1 3", "n 3", "n 3", "n", "n 3", "n", "=", "=")
    by_changed = c.ByChangedArrays(*(c.maybe(c.array(shape), 0.7) for shape in shapes))
    written = [arrays.offset_basis, arrays.color_basis, arrays.opacity_basis, arrays.neutral, *arrays[7:]]
    gradients = c.ChangeGradients(*(None if one is None else np.zeros_like(one) for one in written))
    return [own, given[1], arrays, changed, weights, *c.given("n 3", "n"), by_changed, gradients]


def ride_backward(c: Call) -> Arguments:
    model, topology, in_head, face, local, posed = ride(c)[:6]
    own = c.native.ride(model, topology, in_head, face, local, posed)
    by_posed = c.PosedGaussians("n 3", "n 4", "n 3", "n", "4 4")
    by_local = c.LocalGaussians("=n 3", "=n 4", "=n 3", "=n")
    moved = c.maybe(c.FaceParameterGradients("=1 e", "=1 j 3", "=1 3", "=1 3"), 0.7)
    return [own, model, topology, face, local, posed.scales, posed.opacities, by_posed, by_local, moved]


# Pictures of Gaussians


def view(c: Call) -> Any:
    scales = np.exp(c.array("g 3") - 3).astype(F32)
    gaussians = c.GaussianArrays(0.5 * c.array("g 3"), "g 4", scales, "%g", "g q 3")
    K, viewmat = c.camera()
    return c.RasterizeView(gaussians, np.ones(3, F32), viewmat, K, "=H W 3", "=H W", "=g:i4")


def views(c: Call) -> list[Any]:
    return [view(Call(c.native, c.rng)) for _ in range(c.size("a"))]


def rasterize_views_backward(c: Call) -> Arguments:
    drawn, tasks = views(c), []
    for own, frame in zip(drawn, c.native.rasterize_views(drawn, True), strict=True):
        c.sizes |= dict(zip("HW", own.alpha.shape, strict=True))
        gradients = c.native.GaussianArrays(*(np.zeros_like(array) for array in own.gaussians))
        of_view = f"={len(gradients.means)} 2", "=4 4", "=3 3"
        known = frame, own.gaussians, own.image, own.alpha
        tasks.append(c.RasterizeGradients(*known, "H W 3", "?H W", gradients, *of_view))
    return [tasks]


# Meshes


def rasterize_mesh(c: Call) -> Arguments:
    return c.given("V 3", "<V t 3", *c.camera(), c.flag(), c.Fragments("=H W:i4", "=H W 3", "=H W"))


def fragments(c: Call) -> Arguments:
    """Return a drawn mesh, its image points and its faces."""
    vertices, faces, K, viewmat, _, out = rasterize_mesh(c)
    c.native.rasterize_mesh(vertices, faces, K, viewmat, False, out)
    return [out, np.ascontiguousarray((vertices @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T, F32), faces]


def drawn(c: Call) -> tuple[Any, Any]:
    """Return the triangles of pixels and the places in them."""
    return fragments(c)[0][:2]


def with_edges(c: Call) -> Arguments:
    """Return a drawn mesh with all edges of all faces; half of the edges have a second triangle."""
    out, points, faces = fragments(c)
    vertices = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int32)
    opposite = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]]).astype(np.int32)
    own = np.tile(np.arange(len(faces), dtype=np.int32), 3)
    other = np.where(c.rng.random(len(own)) < 0.5, np.int32(-1), c.array("<t 3*t:i4"))
    arrays = vertices, np.stack([own, other], 1), opposite
    return [out, points, faces, c.native.MeshEdges(*(np.ascontiguousarray(array) for array in arrays))]


def mesh_loss(c: Call) -> Arguments:
    target = c.LossTarget("H W 3", "+H W", 0.1)
    gradients = c.LossGradients("=V 3:f8", "=V 3", "=m n 3", "=9 3:f8")
    surface = c.LitSurface("V 3", "t 3 2", "+t", "m n 3", "9 3")
    return c.given(*with_edges(c), surface, target, "=H W 3", gradients)


SURFACE = ("<V t 3", "%t 3 2", "<2 t:u1", "+G U 3", "+G U", 0.1, 3.0, 0.05)


def sighting(c: Call, *others: Any) -> Arguments:
    """Return a surface and a picture of it."""
    seen = c.SightingArrays("V 3", "V 3", *c.camera(), "H W 3", np.ones(c.picture(), F32), "9 3")
    return c.given(c.AlignSurface(*SURFACE), seen, *others)


def steps(c: Call) -> np.ndarray:
    return np.array(c.rng.integers(0, 9), F32)


MAKERS: dict[str, Callable[[Call], Arguments]] = {
    "AlignSurface": lambda c: c.given(*SURFACE),
    "absolute_difference": lambda c: c.given("H W", "<256 H W:u1", 0.5, "=H W", "="),
    "activate_points": lambda c: [
        c.RawPoints("n 11", "n 3", "n 4", "n", "n 3"), 0.5, 0.1, c.ActivatedPoints("=n 3", "=n 4", "=n", "=n 1 3")],
    "activation_shape": lambda c: [c.make_face_activations(*face_activations(c))],
    "activation_table": lambda c: [
        own := c.make_face_activations(*face_activations(c)), *c.given("j", "3", "3", "3"),
        np.zeros(c.native.activation_shape(own), F32)],
    "adam_update": lambda c: [[
        Call(c.native, c.rng).AdamTask("n d", "n d", "n d", "+n d", steps(c), 0.01, 2) for _ in range(c.size("a"))]],
    "add_arrays": lambda c: [c.given("n", "n 3"), c.given("n", "n 3"), c.given("=n", "=n 3")],
    "add_bone": lambda c: c.given("b 3", "b", "3 4", "b 3"),
    "align_mesh": lambda c: sighting(c, int(c.rng.integers(0, 9)), *(c.maybe(one, 0.7) for one in c.given(
        c.AlignDerivatives("V 3 p", "=p p", "=p"), "=H W 3", "=H W 3"))),
    "bake_texture": lambda c: sighting(
        c, c.array("<t+1 G U:i4") - np.int32(1), "G U 3", c.TextureSums("=G U", "=G U 3", "=G U 3", "=G U 3")),
    "box_of_nonzero": lambda c: [np.maximum(c.array("H W") - 2, 0)],
    "clear_rows": lambda c: [c.array("<2 n:u1"), c.given("n", "n 3", "n 2 4")],
    "compose_rigid": lambda c: c.given("4 4", "4 4", "=4 4"),
    "compose_rigid_backward": lambda c: c.given("4 4", "4 4", "4 4", "=4 4", "=4 4"),
    "color_difference": lambda c: c.given(
        "H W 3", "<256 H W 3:u1", "?<2 H W:u1", 0.5, 0.1, "=H W 3", "="),
    "composite": lambda c: c.given("<256 H W 3:u1", "<256 H W:u1", [1, 2, 255], c.box(), "=H W 3:u1"),
    "expression_change": lambda c: c.given("n 3? r", "a r", "?<a n", "=n 3?"),
    "factored_adam_update": lambda c: factored(c, "n k f", "+n k f", steps(c)),
    "factored_update": lambda c: factored(c, "+n f", "+n"),
    "feature_network": lambda c: c.given(*network(c), c.maybe(c.FeatureKept("=n f", "=n h^")), "=n o", "=n"),
    "feature_network_backward": feature_network_backward,
    "head_poses": lambda c: c.given("n 3", "n 3", "=n 4 4"),
    "head_poses_backward": lambda c: c.given("n 3", "n 4 4", "=n 3"),
    "interpolate_mesh": lambda c: c.given(*drawn(c), "V c", "<V t 3", "=H W c"),
    "keep_on_surface": lambda c: c.given("<r n", "r 5", 1.6, "n 3", "n 4", "n 3", "?r 4", "n 3"),
    "light_equations": lambda c: sighting(c, "=3 9 9:f8", "=3 9:f8"),
    "make_face_activations": lambda c: c.given(*face_activations(c)),
    "make_face_model": make_face_model,
    "make_rig_topology": lambda c: c.given(c.size("v"), "<v t 3", "<t n"),
    "mean_squared_difference": lambda c: c.given("H W 3", "<256 H W 3:u1"),
    "keep_loops_serial": lambda c: [c.flag()],
    "mesh_loss": mesh_loss,
    "observe_view": lambda c: c.given((2.0, 3.0), "n 2", "<3 n:i4", "n", "=n", "=n", "=n:i4", "=n"),
    "photometric_loss": lambda c: c.given(
        tuple(c.box()), (0.8, 0.2), "H W 3", "<256 H W 3:u1" if c.flag() else "H W 3", "?+H W", "?=H W 3", "="),
    "point_network": lambda c: c.given(*point_layers(c), "?=n y", "=n l"),
    "point_network_backward": point_network_backward,
    "pose_face": lambda c: c.given(*posing(c), "=b v 3", "=b v 3"),
    "pose_face_backward": lambda c: c.given(
        *posing(c), "b v 3", "b v 3", c.FaceArrays("=b v 3", "=b j+1 3", "=b e", "=b j 3", "=b 3", "=b 3")),
    "rasterize_isa": lambda c: [],
    "rasterize_mesh": rasterize_mesh,
    "rasterize_views": lambda c: [views(c), c.flag(0.7)],
    "rasterize_views_backward": rasterize_views_backward,
    "recycled": lambda c: [[c.size("n"), c.size("m")]],
    "release_memory": lambda c: [],
    "recycled_twice": lambda c: [[c.size("n"), c.size("m")]],
    "ride": ride,
    "ride_backward": ride_backward,
    "ride_changes_backward": ride_changes_backward,
    "rig_backward": rig_backward,
    "rig_forward": rig_forward,
    "sample_texture": lambda c: c.given("H W d", "n 2", "=n d"),
    "set_rasterize_isa": lambda c: [str(c.rng.choice(["avx512", "avx2", "sse4", "baseline", ""]))],
    "set_thread_count": lambda c: [c.size("b")],
    "sigmoid": lambda c: c.given("n m", "=n m"),
    "sigmoid_backward": lambda c: c.given("n", "n", "=n"),
    "skin_points": lambda c: c.given(skinned(c), "=B n 3"),
    "skin_points_backward": lambda c: [
        skinned(c), c.SkinPointsGradients("B n 3", "=n 3", "=B n 3", "=n K", "=B K 3 4")],
    "thread_count": lambda c: [],
    "triangle_penalties": lambda c: c.given(
        (1.0, 0.6), (0.01, 1.0), "n 3", "n 3", "<3 n:i4", "=n 3", "=n 3", "=", "="),
}  # fmt: skip
"""Name of a native function -> the parts that make the arguments of a valid call."""


def arguments_of(name: str, native: Any, rng: Rng) -> Arguments:
    """Return the positional arguments of a valid call."""
    return MAKERS[name](Call(native, rng))
