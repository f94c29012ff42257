"""Licences of everything that is installed beside mien, and of the models and data that mien uses.

`installed_licences` lists packages, `PARTS` what is inside mien's own files and inside packages. `spdx_document` is the
list of mien's own parts and requirements that each wheel carries. Nothing here is legal advice.
"""

from mien.licences.facts import PARTS, Kind, Part
from mien.licences.installed import Licence, installed_licences
from mien.licences.spdx import spdx_document

__all__ = ["PARTS", "Kind", "Licence", "Part", "installed_licences", "spdx_document"]
