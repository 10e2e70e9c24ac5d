"""Defines the package's operators when torch is imported, whether before or after this package.

`torch.export.load` looks operators up by name, before any function of this package is called. The
package itself does not import torch, so that `import lardhm_torch` and `lardhm --help` are fast.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

OPERATORS = "lardhm_torch.native.operators"


class _AfterTorch:
    """A finder that defines the operators at the end of `import torch`."""

    def __init__(self) -> None:
        self._is_searching = False

    def find_spec(self, name: str, *_: Any) -> ModuleSpec | None:
        if name != "torch" or self._is_searching:
            return None
        self._is_searching = True
        try:
            spec = importlib.util.find_spec("torch")  # by the other finders
        finally:
            self._is_searching = False
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def run_and_define(module: ModuleType) -> None:
                run(module)
                sys.meta_path.remove(self)
                importlib.import_module(OPERATORS)

            spec.loader.exec_module = run_and_define  # type: ignore[method-assign]
        return spec


def define_operators() -> None:
    """Define the operators now if torch is imported, and otherwise as soon as it is."""
    if "torch" in sys.modules:
        importlib.import_module(OPERATORS)
    else:
        sys.meta_path.insert(0, _AfterTorch())
