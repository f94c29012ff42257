"""The result of a fit to pixels: the fit and the subject's appearance."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.tracking.photometric_texture import Appearance
from mien.tracking.stages import Fit, fit_of


@dataclass(frozen=True, eq=False)
class PhotometricFit:
    """A fit to pixels with the texture and light that it found."""

    fit: Fit
    appearance: Appearance
    lights: tuple[Float[Tensor, "9 3"], ...]
    """Light of each sequence."""
    improved: tuple[Bool[Tensor, " _"], ...]
    """Timesteps of each sequence that the fit to pixels improved. The others keep their fit to landmarks."""
    residuals: tuple[Float[Tensor, "_ _"], ...] = ()
    """`PhotometricTerm.residuals` of each sequence; NaN where not improved."""

    def tensors(self) -> dict[str, Tensor]:
        """Everything but the residuals as tensors by name, for a file."""
        tensors = self.fit.tensors() | {"albedo": self.appearance.albedo, "trust": self.appearance.trust}
        tensors["sigma"] = torch.tensor([self.appearance.sigma], dtype=torch.float64)
        for index, (light, improved) in enumerate(zip(self.lights, self.improved, strict=True)):
            tensors |= {f"light_{index}": light, f"improved_{index}": improved.to(torch.uint8)}
        return tensors


def photometric_fit_of(tensors: Mapping[str, Tensor]) -> PhotometricFit:
    """The fit made of tensors by name (`PhotometricFit.tensors`)."""
    fit = fit_of(tensors)
    count = range(len(fit.sequences))
    return PhotometricFit(
        fit, Appearance(tensors["albedo"], tensors["trust"], float(tensors["sigma"])),
        tuple(tensors[f"light_{index}"] for index in count),
        tuple(tensors[f"improved_{index}"].bool() for index in count),
    )  # fmt: skip
