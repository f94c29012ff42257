"""Licences of everything that is installed beside mien, and of the models and data that mien uses.

`installed_licences` lists packages, `PARTS` what is inside mien's own files and inside packages. `spdx_document` is the
list of mien's own parts and requirements that each wheel carries. Nothing here is legal advice.
"""
