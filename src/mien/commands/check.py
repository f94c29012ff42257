"""`mien check`: the mistakes of the avatar in a .glb file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mien.errors import UserError
from mien.machine.terminal import counted, show


@dataclass(frozen=True)
class Command:
    """Compare the avatar in a .glb file with its description (docs/spec), and print a line for each mistake."""

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """A .glb file, of mien or of another program."""

    def run(self) -> None:
        """Print the mistakes."""
        from mien.formats.glb import glb_faults

        faults = glb_faults(self.file)
        for fault in faults:
            show(fault)
        if faults:
            found = counted(len(faults), "mistake")
            raise UserError(f"{self.file}: has {found}; docs/spec/README.md says what is expected")
        show(f"{self.file}: follows docs/spec/README.md")
