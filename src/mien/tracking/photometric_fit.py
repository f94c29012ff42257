"""What a fit to pixels comes to: the fit, and the subject's looks."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.tracking.photometric_texture import Appearance
from mien.tracking.stages import Fit, fit_of


@dataclass(frozen=True, eq=False)
class PhotometricFit:
    """A fit with what it found out about the subject's looks."""

    fit: Fit
    appearance: Appearance
    lights: tuple[Float[Tensor, "9 3"], ...]
    """Of each sequence."""
    improved: tuple[Bool[Tensor, " _"], ...]
    """Of each sequence, timesteps that pixels made better; the others stay as landmarks had them."""
    residuals: tuple[Float[Tensor, "_ _"], ...] = ()
    """Of each sequence: `PhotometricTerm.residuals`, NaN where not improved."""

    def tensors(self) -> dict[str, Tensor]:
        """By name, for a file: all but the residuals."""
        tensors = self.fit.tensors() | {"albedo": self.appearance.albedo, "trust": self.appearance.trust}
        tensors["sigma"] = torch.tensor([self.appearance.sigma], dtype=torch.float64)
        for index, (light, improved) in enumerate(zip(self.lights, self.improved, strict=True)):
            tensors |= {f"light_{index}": light, f"improved_{index}": improved.to(torch.uint8)}
        return tensors


def photometric_fit_of(tensors: Mapping[str, Tensor]) -> PhotometricFit:
    """The fit with these tensors (`PhotometricFit.tensors`)."""
    fit = fit_of(tensors)
    count = range(len(fit.sequences))
    return PhotometricFit(
        fit, Appearance(tensors["albedo"], tensors["trust"], float(tensors["sigma"])),
        tuple(tensors[f"light_{index}"] for index in count),
        tuple(tensors[f"improved_{index}"].bool() for index in count),
    )  # fmt: skip
