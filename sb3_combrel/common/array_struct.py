"""Structs of arrays that compiled code is handed as one address.

Numba takes a tuple of arrays apart, array by array, in the code of every call from Python: for our hundred arrays that
code takes as long to compile as the work itself. Here the addresses and shapes of the arrays are written to a table once,
when a struct is made, and compiled code looks them up there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self, dataclass_transform

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.typing.templates import AttributeTemplate
from numba.extending import NativeValue, infer_getattr, lower_getattr_generic, models, register_model, typeof_impl, unbox
from numba.np.numpy_support import from_dtype


class ArrayStructType(types.Type):
    """The type of an :class:`ArrayStruct` in compiled code.

    :param fields: (name, type) of each
    """

    def __init__(self, name: str, fields: tuple[tuple[str, Any], ...]):
        self.fields = fields
        self.length = sum(_length(kind) for _, kind in fields)
        super().__init__(name=f"{name}({', '.join(f'{field}: {kind}' for field, kind in fields)})")

    def find(self, name: str) -> tuple[int, Any] | None:
        """Where in the table a field begins, and its type."""
        at = 0
        for field, kind in self.fields:
            if field == name:
                return at, kind
            at += _length(kind)
        return None


def _length(kind: Any) -> int:
    """Numbers that a field has in the table: for an array its address and its shape."""
    length: int = kind.length if isinstance(kind, ArrayStructType) else 1 + kind.ndim
    return length


@dataclass_transform(frozen_default=True, eq_default=False)
class ArrayStruct:
    """Base of classes whose fields, declared as those of a dataclass, are C-contiguous arrays, or structs of these.

    A field cannot be exchanged; :meth:`replace` makes a new struct. The fields have the same types in all structs of a
    class, those of the first one made: compiled code relies on it.

    :raises TypeError: if a field is something else, or has another type
    """

    compiled_type: ClassVar[ArrayStructType | None] = None
    __dataclass_fields__: ClassVar[dict[str, Any]]
    _table: np.ndarray
    _address: int

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, eq=False)(cls)

    def __post_init__(self) -> None:
        kind = type(self)
        types_here = tuple((name, _type_of(value, f"{kind.__name__}.{name}")) for name, value in self.arrays().items())
        if kind.compiled_type is None:
            kind.compiled_type = ArrayStructType(kind.__name__, types_here)
        for (name, expected), (_, given) in zip(kind.compiled_type.fields, types_here, strict=True):
            if given != expected:
                raise TypeError(f"{kind.__name__}.{name} must be {expected}, got {given}")
        numbers: list[int] = []
        for value in self.arrays().values():
            numbers += value._table.tolist() if isinstance(value, ArrayStruct) else [value.ctypes.data, *value.shape]
        vars(self)["_table"] = np.array(numbers, dtype=np.int64)
        vars(self)["_address"] = self._table.ctypes.data

    def arrays(self) -> dict[str, Any]:
        """The fields, by name."""
        return {name: vars(self)[name] for name in self.__dataclass_fields__}

    def replace(self, **changed: Any) -> Self:
        """A struct with other arrays for some fields."""
        return type(self)(**{**self.arrays(), **changed})

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy has arrays of its own, at other addresses.
        return type(self), tuple(self.arrays().values())


def _type_of(value: Any, name: str) -> Any:
    if isinstance(value, ArrayStruct):
        return value.compiled_type
    if not (isinstance(value, np.ndarray) and value.flags.carray):
        given = f"one of shape {value.shape} that is not" if isinstance(value, np.ndarray) else repr(value)
        raise TypeError(f"{name} must be a C-contiguous, writeable array or an ArrayStruct, got {given}")
    return types.Array(from_dtype(value.dtype), value.ndim, "C")


register_model(ArrayStructType)(models.OpaqueModel)


@typeof_impl.register(ArrayStruct)
def _typeof(struct: ArrayStruct, _context: Any) -> ArrayStructType | None:
    return struct.compiled_type


@unbox(ArrayStructType)
def _unbox(_kind: ArrayStructType, struct: Any, c: Any) -> NativeValue:
    number = c.pyapi.object_getattr_string(struct, "_address")
    address = c.pyapi.long_as_voidptr(number)
    c.pyapi.decref(number)
    return NativeValue(address)


@infer_getattr
class _FieldTypes(AttributeTemplate):
    key = ArrayStructType

    def generic_resolve(self, kind: ArrayStructType, name: str) -> Any:  # type: ignore[override]
        found = kind.find(name)
        return None if found is None else found[1]


@lower_getattr_generic(ArrayStructType)
def _read_field(context: Any, builder: Any, kind: ArrayStructType, struct: Any, name: str) -> Any:
    """Code that looks up a field: of an array, its address and shape; of a struct, where its part of the table begins."""
    from numba.np.arrayobj import make_array, populate_array

    found = kind.find(name)
    assert found is not None
    at, field = found
    word = ir.IntType(64)
    table = builder.bitcast(struct, word.as_pointer())
    if isinstance(field, ArrayStructType):
        return builder.bitcast(builder.gep(table, [word(at)]), struct.type)

    def read(n: int) -> Any:
        number = builder.load(builder.gep(table, [word(at + n)]))
        # The table is never written again: once read, a number need not be read anew after each write to an array.
        number.set_metadata("invariant.load", builder.module.add_metadata([]))
        return number

    array = make_array(field)(context, builder)
    shape = [read(1 + axis) for axis in range(field.ndim)]
    strides = [word(context.get_abi_sizeof(context.get_data_type(field.dtype)))]
    for length in shape[:0:-1]:
        strides.insert(0, builder.mul(strides[0], length))
    data = builder.inttoptr(read(0), array.data.type)
    populate_array(array, data=data, shape=shape, strides=strides, itemsize=strides[-1], meminfo=None)
    return array._getvalue()
