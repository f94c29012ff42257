"""The verbs of the commands, one a file: functions that a notebook can call.

`capture`, `track`, `align`, `train`, `evaluate` and `create` make an avatar, `draw`, `drive`, `follow`, `export` and
`view` use one, and `import_dataset`, `export_dataset` and `face_models` exchange data with other programs. `names`
checks what was asked for before any work.
"""
