"""Presets, from quick to good: names for the settings of a run and of its method."""

from dataclasses import dataclass

from mien.avatar import MethodConfig, method_named
from mien.training.settings import TrainSettings


@dataclass(frozen=True)
class Preset:
    """The settings of a run, which are given here, and of each method, which are in the file of its settings."""

    name: str
    settings: TrainSettings

    def config(self, method: str) -> MethodConfig:
        """The settings of a method.

        Raises:
            UserError: there is no method of that name.
        """
        return method_named(method).presets[self.name]


PRESETS = {
    preset.name: preset for preset in (Preset("draft", TrainSettings(steps=8_000)), Preset("standard", TrainSettings()))
}
"""Presets by name, from quick to good."""
