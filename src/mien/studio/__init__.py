"""The studio: a page in the browser that films a person, has the avatar made, and hands it over.

Every stage is a command of mien in a process of its own: `create`, `export`. The room adds none. `people` has what lies
on disk, `making` the queue of commands, `taking` what can be taken away, `app` the answers to requests, and `server`
the sockets.
"""
