"""The front end of Triton's compiler: types, loops, branches. What comes behind it takes most of the time."""

from __future__ import annotations


def intermediate(source) -> str:
    """What it makes of an `ASTSource` of one warp."""
    from triton._C.libtriton import ir  # pyright: ignore[reportMissingImports]
    from triton.backends.compiler import GPUTarget  # pyright: ignore[reportMissingImports]
    from triton.compiler.compiler import make_backend  # pyright: ignore[reportMissingImports]

    target = GPUTarget("cuda", 80, 32)
    backend, context = make_backend(target), ir.context()
    ir.load_dialects(context)
    backend.load_dialects(context)
    options = backend.parse_options({"num_warps": 1})
    given = target, options, backend.get_codegen_implementation(options), backend.get_module_map(), context
    return str(source.make_ir(*given))
