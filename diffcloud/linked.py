"""Kernels that numba compiles once and links into their callers.

By default, numba makes each compiled function callable on its own: with machine code of all functions that it calls,
and with a wrapper for Python arguments. Most kernels are only called by other kernels, and need neither. Linked code is
already optimised, and not optimised again. This halves the compilation time; simulations are as fast as before. Kernels
also do not count references to their arguments.
"""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import ir
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserProvidedCacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.lowering import Lower
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering

_PACKAGE = Path(__file__).resolve().parent
_LARGE = 8
"""A kernel that calls more kernels than this is not optimised with them, since each is optimised already."""


class LinkedKernel(CPUDispatcher):
    """A kernel that other kernels call. For calls from Python, it has a separate entry function in numba's cache."""

    def __init__(self, function: Callable[..., Any], **options: Any) -> None:
        super().__init__(
            py_func=function,
            targetoptions=options | {"nopython": True, "no_cpython_wrapper": True},
            pipeline_class=_LinkedCompiler,
        )
        self._entry = njit(pipeline_class=_EntryCompiler, **options)(_calling(self, function))
        self._entry._cache = _KernelCache(self._entry.py_func)

    def __call__(self, *given: Any, **named: Any) -> Any:
        return self._entry(*given, **named)

    def add_overload(self, compiled: Any) -> None:
        """Add a compiled overload without registering it for calls from Python."""
        self.overloads[tuple(compiled.signature.args)] = compiled


class _Locator(UserProvidedCacheLocator):
    """Places cached code by the path of a kernel within the package. So all installations of one version share it."""

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        """Return the subfolder for the code of a source file. Files outside of the package have numba's own."""
        folder = Path(py_file).resolve().parent
        inside = folder.is_relative_to(_PACKAGE)
        return str(folder.relative_to(_PACKAGE) if inside else super().get_suitable_cache_subpath(py_file))


class _KernelCacheImpl(CompileResultCacheImpl):
    def __init__(self, py_func: Callable[..., Any]) -> None:
        self._locator_classes = [_Locator, *CompileResultCacheImpl._locator_classes]
        super().__init__(py_func)


class _KernelCache(FunctionCache):
    _impl_class = _KernelCacheImpl


def _calling(linked: LinkedKernel, function: Callable[..., Any]) -> Callable[..., Any]:
    """Create an entry function that only calls the kernel. numba's cache sees it at the kernel's source location."""
    name, parameters = function.__name__, inspect.signature(function).parameters.values()
    taken = ", ".join(one.name if one.default is one.empty else f"{one.name}={one.default!r}" for one in parameters)
    source = f"def {name}({taken}):\n    return linked({', '.join(one.name for one in parameters)})"
    scope: dict[str, Any] = {"linked": linked, "__name__": function.__module__}
    exec(compile(source, function.__code__.co_filename, "exec"), scope)
    scope[name].__qualname__ = function.__qualname__
    found: Callable[..., Any] = scope[name]
    return found


class _Library(JITCodeLibrary):
    """Code of a kernel and of all functions that it calls."""

    def _optimize_final_module(self) -> None:
        large = len(_below(self)) > _LARGE
        options = {"loop_vectorize": False, "slp_vectorize": False, "opt": 0} if large else {}
        manager, builder = self._codegen._module_pass_manager(cost="cheap", **options)
        manager.run(self._final_module, builder)


class _LinkedLibrary(_Library):
    """A library that is only linked into others and never executed by itself."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


def _below(library: JITCodeLibrary) -> set[JITCodeLibrary]:
    """All kernels that are linked into a library, directly or indirectly."""
    found: set[JITCodeLibrary] = set()
    for one in library._linking_libraries:
        if isinstance(one, _LinkedLibrary) and one not in found:
            found |= {one, *_below(one)}
    return found


class _Borrowing(Lower):
    """Lowering that takes no references to arguments, since the caller holds them until the function returns.

    Kernels are small and numerous; counting references would take a fifth of their time.
    """

    def pre_lower(self) -> None:
        super().pre_lower()
        targets = Counter[str]()
        given = set()
        for block in self.blocks.values():
            for statement in block.find_insts(ir.Assign):
                targets[statement.target.name] += 1
                if isinstance(statement.value, ir.Arg):
                    given.add(statement.target.name)
        self._borrowed = {name for name in given if targets[name] == 1}

    def lower_assign(self, kind: Any, statement: Any) -> Any:
        found = super().lower_assign(kind, statement)
        if statement.target.name in self._borrowed:
            self.decref(kind, found)  # numba then removes the incref together with this decref
        return found

    def delvar(self, name: str) -> None:
        if name not in self._borrowed:
            super().delvar(name)


@register_pass(mutates_CFG=True, analysis_only=False)
class _LinkedLowering(NativeLowering):
    _name = "linked_lowering"
    lowering_class = _Borrowing

    def run_pass(self, state: Any) -> bool:
        state.library = _LinkedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        state.cr = state.cr._replace(cfunc=object())  # the key by which callers find this function
        state.targetctx.insert_user_function(state.cr.cfunc, state.cr.fndesc, [state.library])
        return True


@register_pass(mutates_CFG=True, analysis_only=False)
class _EntryLowering(NativeLowering):
    _name = "entry_lowering"

    def run_pass(self, state: Any) -> bool:
        state.library = _Library(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return bool(super().run_pass(state))


class _LinkedCompiler(CompilerBase):
    def define_pipelines(self) -> list[PassManager]:
        return [_pipeline(self.state, _LinkedLowering)]


class _EntryCompiler(CompilerBase):
    def define_pipelines(self) -> list[PassManager]:
        return [_pipeline(self.state, _EntryLowering)]


def _pipeline(state: Any, lowering: type[NativeLowering]) -> PassManager:
    """numba's default pipeline with another lowering pass."""
    manager = DefaultPassBuilder.define_nopython_pipeline(state)
    manager.passes = [(lowering if one is NativeLowering else one, why) for one, why in manager.passes]
    manager.finalize()
    return manager
