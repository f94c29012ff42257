"""Licences of everything that is installed beside mien, and of the models and data that mien uses.

`installed_licences` lists packages, `PARTS` what is inside mien's own files and inside packages. Nothing here is legal
advice. `release/sbom.py` makes the SPDX document of mien's wheel from the same facts.
"""
