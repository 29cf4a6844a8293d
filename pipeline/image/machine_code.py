"""Loops over arrays as machine code, and what such a loop may ask of the compiler and of the processor's memory.

`numbers` and `ask_for_line` do next to nothing when Python runs them: compiled loops and their source give the same.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

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
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": counted}
    return numba.njit(**options)(function)  # type: ignore[no-any-return]


def numbers(row: np.ndarray, like: tuple[int, ...]) -> tuple[float, ...]:
    """A row as a tuple of the length of ``like``: a loop over it is unrolled, and it stays in registers."""
    return tuple(row)


def ask_for_line(address: int) -> None:
    """Have memory send the line of cache at an address, be it ours or not, while something else is worked on."""


@functools.cache
def _known_here() -> None:
    """Tell the compiler what `numbers` and `ask_for_line` are in its world."""
    from numba.extending import overload
    from numba.np.unsafe.ndarray import to_fixed_tuple

    def as_numbers(row: Any, like: Any) -> Callable[..., Any]:
        count = len(like)

        def fixed(row: Any, like: Any) -> Any:
            return to_fixed_tuple(row, count)  # type: ignore[call-arg]

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
