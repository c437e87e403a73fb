"""Coexistence of OpenGL drivers with other native libraries of the process.

Mesa's software renderer loads its LLVM with global symbols. Triton, which PyTorch imports with the first optimizer, has
an LLVM of its own. If it is loaded after the first image, it finds the symbols of Mesa's LLVM, and the process crashes.
"""

from __future__ import annotations

import ctypes
import os
import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from typing import Any


class _TritonFinder(MetaPathFinder):
    """Loads the library of Triton so that it finds its own symbols first, at the moment of its import."""

    def __init__(self) -> None:
        self._is_done = False

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Returns None: the other finders find the module."""
        # the finder stays in the list of finders, through which its caller walks; a search is not always an import
        if fullname == "triton" and not self._is_done and _has_llvm_of_mesa():
            self._is_done = True
            _load_triton()
        return None


def _has_llvm_of_mesa() -> bool:
    """Returns True if a shared LLVM is in the process."""
    try:
        with open("/proc/self/maps") as maps:
            return any("libLLVM" in line for line in maps)
    except OSError:
        return False


def _load_triton() -> None:
    spec = PathFinder.find_spec("triton")
    for folder in (spec.submodule_search_locations if spec else None) or ():
        library = os.path.join(folder, "_C", "libtriton.so")
        if os.path.exists(library):
            # the import of the module gets the library that is loaded already
            ctypes.CDLL(library, mode=os.RTLD_LAZY | getattr(os, "RTLD_DEEPBIND", 0))


_is_prepared = False


def prepare() -> None:
    """Prepares the process for images. Every environment calls it before it may create an OpenGL context."""
    global _is_prepared
    if not _is_prepared:
        _is_prepared = True
        if "triton" not in sys.modules:
            sys.meta_path.insert(0, _TritonFinder())
