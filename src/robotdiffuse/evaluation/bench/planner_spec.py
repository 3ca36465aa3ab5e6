"""A planner under test: its name, and weights and settings other than the defaults."""

from dataclasses import dataclass, fields
from pathlib import Path as FilePath
from typing import Any

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.input_files import is_file
from robotdiffuse.core.settings import Settings
from robotdiffuse.learning.networks import NETWORKS
from robotdiffuse.learning.weight_files import read_description
from robotdiffuse.learning.weights_registry import folder_of
from robotdiffuse.planning import PLANNERS, load_planner, planner_settings
from robotdiffuse.planning.context import PlanRequest
from robotdiffuse.planning.planner import Planner

CALL_ARGUMENTS = [field.name for field in fields(PlanRequest) if field.name not in ("time_limit", "seed")]
"""Arguments of a planner's calls that a planner under test may set; the bench sets the others."""


@dataclass(frozen=True)
class PlannerSpec:
    """A planner as the bench loads and calls it."""

    name: str
    """In `planning.PLANNERS`."""
    weights: str | None = None
    """A folder; None: those that come with the package."""
    settings: tuple[str, ...] = ()
    """NAME=VALUE of the planner's settings and of its calls' arguments (`PlanRequest`)."""

    @classmethod
    def parse(cls, text: str) -> "PlannerSpec":
        """Parse NAME, NAME@WEIGHTS, NAME:SETTING=VALUE:SETTING=VALUE or NAME@WEIGHTS:SETTING=VALUE.

        Raises InputError for an unknown planner or setting, listing the known ones, and for a value out of
        bounds.
        """
        whole, *settings = text.split(":")
        name, at, folder = whole.partition("@")
        PLANNERS.entry(name)
        found = cls(name, str(folder_of(folder).resolve()) if at else None, tuple(settings))
        found.request()
        if settings:
            found._settings()
        return found

    @property
    def text(self) -> str:
        """The text that `parse` makes this from, with an absolute folder."""
        return ":".join(
            [self.name if self.weights is None else f"{self.name}@{self.weights}", *self.settings]
        )

    @property
    def label(self) -> str:
        """Its name in results."""
        name = self.name if self.weights is None else f"{self.name}@{FilePath(self.weights).name}"
        return ":".join([name, *self.settings])

    @property
    def weights_hashes(self) -> dict[str, Any]:
        """SHA-256 of the weights in its folder, by network; empty without a folder."""
        if self.weights is None:
            return {}
        folder = FilePath(self.weights)
        names = [name for name in NETWORKS if is_file(folder / f"{name}.json")]
        return {name: read_description(folder, name).get("weights_sha256") for name in names}

    def request(self) -> dict[str, Any]:
        """Arguments of its calls: until, clearance, ..."""
        request = PlanRequest().changed(text for text in self.settings if _of_call(text))
        return {name: getattr(request, name) for name in CALL_ARGUMENTS}

    def load(self) -> Planner:
        """Load the planner. Raises InputError as `load_planner` does, and for a planner that another process
        cannot import."""
        if PLANNERS.entry(self.name).location.startswith("__main__:"):
            raise InputError(
                f"planner {self.name} is in the program that was started, which the processes of a bench do "
                "not import; put it into a module of its own"
            )
        if not self.settings:
            return load_planner(self.name, weights=self.weights)
        return load_planner(self.name, self._settings())

    def _settings(self) -> Settings:
        weights = () if self.weights is None else (f"weights={self.weights}",)
        own = (text for text in self.settings if not _of_call(text))
        return planner_settings(self.name, (*weights, *own))


def _of_call(text: str) -> bool:
    return text.partition("=")[0] in CALL_ARGUMENTS
