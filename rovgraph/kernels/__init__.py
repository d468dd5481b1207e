"""Compiled numeric kernels: the equations of estimation, for one epoch, in loops over small fixed sizes.

Modules read as the equations do. Each entry point has an explicit signature and is compiled once per machine
(`rovgraph.kernels.compile`); helpers are compiled into the entry points that call them. With
``NUMBA_DISABLE_JIT=1`` all of it is plain Python to step through.

Arrays are C-contiguous float64 unless a signature says otherwise. Kernels check nothing: shapes and values are
the caller's to guarantee. Outputs are arguments that end in ``_out``, so that inner loops allocate nothing.
"""
