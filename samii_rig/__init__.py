"""Drive a flexible robot, record it, estimate its frequency responses, hold a model to them."""

from functools import partial
from importlib import import_module
from typing import Any

from samii_rig.display import FORMS

__version__ = "1.0.0"


def _form(module: str, name: str, *of: Any) -> Any:
    return getattr(import_module(f"samii_rig.{module}"), name)(*of)


# What data turn into when somebody asks them in a notebook. Imported when asked.
for _module, _names in {
    "record.convert": ("columns", "samples", "arrays", "lines", "frd"),
    "report.notebook": ("series", "bode", "before_after", "place"),
}.items():
    FORMS.update({name: partial(_form, _module, name) for name in _names})
