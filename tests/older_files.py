"""Content of .mien files as older versions of mien wrote it."""

from dataclasses import replace

import numpy as np

from mien.runtime import Static


def with_a_basis_for_each_input(baked: Static) -> Static:
    """Return an avatar of headgas as before version 6: every input of the face has its own basis of features."""
    network = baked.network
    assert network is not None
    along = network.along
    assert along is not None
    bases = np.einsum("ik,nkw->inw", along.directions, along.basis)
    base, e = network.base.copy(), len(baked.expression_names)
    base[:, : bases.shape[2]] -= np.einsum("i,inw->nw", along.rest, bases)
    return replace(baked, network=replace(network, base=base, basis=bases[:e], joint_basis=bases[e:], along=None))
