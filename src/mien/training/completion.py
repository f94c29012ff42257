"""Stand-in."""

import torch
from jaxtyping import Float
from torch import Tensor

from mien.face import FaceModel


def complete_colors(
    face_model: FaceModel,
    template_vertices: Float[Tensor, "v 3"],
    seen: Float[Tensor, " f"],
    colors: Float[Tensor, "f 3"],
) -> Float[Tensor, "f 3"]:
    """Mirror, else nearest."""
    c = template_vertices[face_model.faces.long()].mean(1)
    good = (seen > 0.5).nonzero()[:, 0]
    bad = (seen <= 0.999).nonzero()[:, 0]
    m = c[bad] * torch.tensor([-1.0, 1, 1])
    out = colors.clone()
    for part in range(0, len(bad), 512):
        sel = slice(part, part + 512)
        dm, im = torch.cdist(m[sel], c[good]).min(1)
        dn, i_n = torch.cdist(c[bad[sel]], c[good]).min(1)
        fill = torch.where((dm < 0.006)[:, None], colors[good[im]], colors[good[i_n]])
        s = seen[bad[sel]][:, None]
        out[bad[sel]] = s * colors[bad[sel]] + (1 - s) * fill
    return out
