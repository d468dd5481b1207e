"""What numba's compiler is asked for, of kernels and of the helpers that only they call.

numba would optimise and assemble each helper by itself, and again within every caller, although nothing but kernels
calls it. Here a helper stops at LLVM's unoptimised code and is linked into its kernels, which alone are optimised and
assembled: that halves the time that all kernels take to compile.

Wrappers are decided here and not by numba's options, because numba compiles a helper once more for each set of options
that its callers have.
"""

from typing import Any, cast

from llvmlite.binding import parse_assembly, parse_bitcode
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompilerBase, DefaultPassBuilder
from numba.core.runtime.nrt import rtsys


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


class KernelLibrary(JITCodeLibrary):
    """Code of a kernel that no other calls but by its address: the cache keeps machine code of it, and its name.

    numba would keep LLVM's code beside it, to be linked into others, and read it again whenever the kernel is loaded,
    which takes longer than all else of loading it.
    """

    def serialize_using_object_code(self) -> tuple[str, str, tuple[bytes, bytes]]:
        """As numba's, with the kernel and its wrappers in name only: it asks whether they are there."""
        name, kind, (machine_code, code) = cast(Any, super()).serialize_using_object_code()
        mangled = f"{len(name)}{name}B"
        names = [f.name for f in parse_bitcode(code).functions if mangled in f.name and not f.is_declaration]
        empty = "".join(f'define void @"{each}"() {{ ret void }}\n' for each in names)
        return name, kind, (machine_code, parse_assembly(empty).as_bitcode() if names else code)


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
    """numba's compiler, with such a library for the kernels of this package."""

    def define_pipelines(self) -> Any:
        """As numba's."""
        if self.state.func_id.modname.rpartition(".")[0] == __package__:
            library: Any = KernelLibrary
            self.state.library = library(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
            self.state.library.enable_object_caching()
        return cast(Any, super()).define_pipelines()


class UncalledKernelCompiler(KernelCompiler):
    """The same without a wrapper for C, which only a kernel that is called by its address needs."""

    def define_pipelines(self) -> Any:
        """As numba's."""
        self.state.flags.no_cfunc_wrapper = True
        return super().define_pipelines()


class _KernelCacheImpl(CompileResultCacheImpl):
    """Keeps the environments of a kernel that its machine code uses, of some forty that were linked into it."""

    def reduce(self, cres: Any) -> tuple[Any, ...]:
        """As numba's."""
        *rest, environments = cast(Any, super()).reduce(cres)
        code = str(cres.library._final_module)
        return *rest, [each for each in environments if code.count(each.env_name) != 1]  # 1: its definition


class KernelCache(FunctionCache):
    """Machine code is loaded without setting up all that numba can compile, which takes a third of a second.

    Kernels need its allocator alone. Those of other packages may call BLAS, which is part of what is left out.
    """

    _impl_class = _KernelCacheImpl

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """As numba's."""
        numbas: Any = self
        if numbas._py_func.__module__.rpartition(".")[0] != __package__:
            return cast(Any, super()).load_overload(sig, target_context)
        allocator: Any = rtsys
        allocator.initialize(target_context)
        with numbas._guard_against_spurious_io_errors():
            return numbas._load_overload(sig, target_context)
