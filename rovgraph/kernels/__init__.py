"""Compiled equations of estimation, for one epoch, in loops over small fixed sizes.

May import `rovgraph.geometry`, `errors`, `process` and nothing else of rovgraph. Begin with `layout` (the error of a
state) and `measurements` (the sensors' equations); then `motion`, `filtering` for the filter, `elimination` for the
smoother.

Each entry point has an explicit signature and is compiled once per machine (`compile`); helpers are compiled into the
entry points that call them. With ``NUMBA_DISABLE_JIT=1`` all of it is plain Python to step through.

Arrays are C-contiguous float64 unless a signature says otherwise. Kernels check no input: the caller guarantees shapes
and values. Outputs are arguments that end in ``_out``, so that inner loops allocate no memory.
"""
