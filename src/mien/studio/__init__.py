"""The studio: a page in the browser that films a person, has the avatar made, and hands it over.

Every stage is a command of mien in a process of its own: `create`, `export`. The room adds none.
"""
