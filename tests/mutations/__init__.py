"""Mutations of mien's code: small mistakes that the tests must catch."""
