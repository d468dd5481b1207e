"""Compiler of helpers: lowered and linked into the kernels that call them, which alone are optimised and assembled.

numba would optimise and assemble each helper by itself, and again within every caller, although nothing but kernels
calls it. Here a helper stops at LLVM's unoptimised code, which halves the time that all kernels take to compile.
"""

from typing import Any, cast

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder


class _NoEnvironment:
    """In place of a code generator, for a function that has no address and hence no environment to set."""

    def set_env(self, name: str, environment: object) -> None:
        """Nothing."""


class LinkedLibrary(JITCodeLibrary):
    """A function's code, to be linked into that of another one and never called by itself."""

    @property
    def codegen(self) -> Any:
        """Asked for to set the function's environment, and for nothing else."""
        return _NoEnvironment()

    def _optimize_final_module(self) -> None:
        """The kernel that it is linked into is optimised."""

    def _finalize_final_module(self) -> None:
        """Ready to be linked, without machine code."""
        cast(Any, self)._finalize_dynamic_globals()
        self._finalized = True


class HelperCompiler(CompilerBase):
    """numba's compiler with such a library."""

    def define_pipelines(self) -> list[Any]:
        """As numba's, without a wrapper for Python."""
        self.state.flags.no_cpython_wrapper = True
        library: Any = LinkedLibrary  # numba's classes have no types
        builder: Any = DefaultPassBuilder
        self.state.library = library(self.state.targetctx.codegen(), "helper")
        return [builder.define_nopython_pipeline(self.state)]
