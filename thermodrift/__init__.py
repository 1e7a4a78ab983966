"""Thermal error of machine tools: recordings, compensation models, the physics twin and its diagnosis.

Names load at their first use, so that importing the package is quick::

    import thermodrift as td
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from data.lake import Lake
    from data.machine import load_machine
    from features.selectors import SELECTORS
    from models.families import FAMILIES
    from models.selection.crossing import Plan
    from thermodrift.api import (
        calibrate,
        cross,
        diagnose,
        export,
        ingest,
        leaderboard,
        load_model,
        predict,
        read,
        registry,
        rehearse,
        sample_year,
        save_model,
        simulate,
        train,
    )
    from twin.calibration import CalibrationOptions
    from twin.mechanisms import MECHANISMS

    __version__: str

__all__ = [
    "FAMILIES", "MECHANISMS", "SELECTORS", "CalibrationOptions", "Lake", "Plan", "__version__", "calibrate", "cross",
    "diagnose", "export", "ingest", "leaderboard", "load_machine", "load_model", "predict", "read", "registry",
    "rehearse", "sample_year", "save_model", "simulate", "train",
]  # fmt: skip
_MODULES = {
    "CalibrationOptions": "twin.calibration", "FAMILIES": "models.families", "Lake": "data.lake",
    "MECHANISMS": "twin.mechanisms", "Plan": "models.selection.crossing", "SELECTORS": "features.selectors",
    "load_machine": "data.machine",
}  # fmt: skip
_ROOMS = (
    "data",
    "features",
    "models",
    "twin",
    "compensation",
    "diagnosis",
    "plants",
    "reports",
    "pipelines",
)


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'thermodrift' has no attribute {name!r}; it has {', '.join(__all__)}")
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("thermodrift")
    else:
        value = getattr(import_module(_MODULES.get(name, "thermodrift.api")), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _check_rooms() -> None:
    """The packages below have common names; a module of the user's with one of them would be imported instead.

    Raises:
        ImportError: Python finds another module of that name, or none.
    """
    for room in _ROOMS:
        expected = Path(__file__).resolve().parents[1] / room / "__init__.py"
        loaded = sys.modules.get(room)
        if loaded is not None:
            found = getattr(loaded, "__file__", None) or next(iter(getattr(loaded, "__path__", [])), None)
        else:
            spec = find_spec(room)
            found = None if spec is None else spec.origin or next(iter(spec.submodule_search_locations or ()), None)
        if found is None:
            raise ImportError(f"thermodrift: its package {room!r} is missing, expected {expected}; install it again")
        if Path(found).resolve() != expected:
            raise ImportError(
                f"thermodrift: {room!r} is {found}, expected its own package {expected}; rename that file or folder, "
                "or start Python in another folder"
            )


_check_rooms()
