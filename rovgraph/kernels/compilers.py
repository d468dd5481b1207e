"""What numba's compiler is asked for, of kernels and of the helpers that only they call.

numba would optimise and assemble each helper by itself, and again within every caller, although nothing but kernels
calls it. Here a helper stops at LLVM's unoptimised code and is linked into its kernels, which alone are optimised and
assembled: that halves the time that all kernels take to compile.

Wrappers are decided here and not by numba's options, because numba compiles a helper once more for each set of options
that its callers have.
"""

from typing import Any, cast

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompilerBase, DefaultPassBuilder


class _NoEnvironment:
    """In place of a code generator, for a function that has no address and hence no environment to set."""

    def set_env(self, name: str, environment: object) -> None:
        """Do nothing: the function has no environment."""


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
    """numba's compiler with such a library, and without wrappers."""

    def define_pipelines(self) -> list[Any]:
        """As numba's."""
        library: Any = LinkedLibrary  # numba's classes have no types
        builder: Any = DefaultPassBuilder
        self.state.flags.no_cpython_wrapper = self.state.flags.no_cfunc_wrapper = True
        self.state.library = library(self.state.targetctx.codegen(), "helper")
        return [builder.define_nopython_pipeline(self.state)]


class KernelCompiler(Compiler):
    """numba's compiler without a wrapper for C, which only a kernel that is called by its address needs."""

    def define_pipelines(self) -> Any:
        """As numba's."""
        self.state.flags.no_cfunc_wrapper = True
        return cast(Any, super()).define_pipelines()
