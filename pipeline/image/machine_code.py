"""Loops over arrays as machine code, and what such a loop may ask of the compiler and of the processor's memory.

`numbers` and `ask_for_line` do next to nothing when Python runs them: compiled loops and their source give the same.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np

from pipeline.run.closure import digest

LINE = 64  # bytes that memory sends at a time


def compiled(function: Callable[..., Any], *helpers: Callable[..., Any], counted: bool = True) -> Callable[..., Any]:
    """A function of arrays and numbers as machine code, kept beside the source: only the first run waits for it.

    It lets go of the interpreter's lock. ``helpers``: functions that it calls, which become part of it. ``counted``:
    it may make arrays; else none, and slices of arrays cost nothing, for nobody counts who holds them.
    """
    import numba
    from numba.extending import register_jitable

    _known_here()
    for helper in helpers:
        register_jitable(helper)
    # `_nrt` has no public name; the documentation of `register_jitable` uses it as well. On, the merge's kernel counts
    # references to every slice that it hands to a helper, and takes 10 to 20 % longer.
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": counted}
    kernel: Any = numba.njit(**options)(function)
    _forget_others(Path(kernel.stats.cache_path), function, options)
    return cast(Callable[..., Any], kernel)


def _forget_others(folder: Path, function: Callable[..., Any], options: dict[str, Any]) -> None:
    """Delete what was kept of a function when the files that it needs, or its options, said something else.

    The compiler compares the function's own file alone; helpers and numbers of other files are part of the code too.
    """
    name = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}"
    note, made_of = folder / f"{name}.made_of", f"{digest(function.__module__)} {options}"
    if note.is_file() and note.read_text() == made_of:
        return
    for index in folder.glob(f"{name}-*.nbi"):
        index.unlink(missing_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    note.write_text(made_of)


def numbers(row: np.ndarray, like: tuple[int, ...]) -> tuple[float, ...]:
    """A row as a tuple of the length of ``like``: a loop over it is unrolled, and it stays in registers."""
    return tuple(row)


def ask_for_line(address: int) -> None:
    """Have memory send the line of cache at an address, be it ours or not, while something else is worked on."""


@functools.cache
def _known_here() -> None:
    """Tell the compiler what `numbers` and `ask_for_line` are in its world."""
    from numba.extending import overload
    from numba.np.unsafe import ndarray

    to_fixed_tuple: Any = ndarray.to_fixed_tuple  # an intrinsic: the compiler supplies its first argument

    def as_numbers(row: Any, like: Any) -> Callable[..., Any]:
        count = len(like)

        def fixed(row: Any, like: Any) -> Any:
            return to_fixed_tuple(row, count)

        return fixed

    def as_prefetch(address: Any) -> Callable[..., Any]:
        prefetch = _prefetch()

        def ask(address: Any) -> None:
            prefetch(address)

        return ask

    overload(numbers)(as_numbers)
    overload(ask_for_line)(as_prefetch)


@functools.cache
def _prefetch() -> Any:
    """The processor's instruction, as LLVM's language reference names it: to read, into all caches, data."""
    from numba.core import cgutils, types
    from numba.extending import intrinsic

    ir: Any = cgutils.ir

    def prefetch(context: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            number, read, everywhere, data = ir.IntType(32), 0, 3, 1
            kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, number, number, number])
            call = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
            pointer = builder.inttoptr(arguments[0], cgutils.voidptr_t)
            builder.call(call, [pointer, *(number(value) for value in (read, everywhere, data))])
            return context.get_dummy_value()

        return types.void(types.int64), generate

    return intrinsic(prefetch)
