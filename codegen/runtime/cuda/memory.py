"""Arrays in the memory of a GPU, with the index of a case or of a thread last in memory.

With numba's simulator the memory of the device is that of the process.
"""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from numba import cuda

from codegen.runtime.cuda.functions import IS_SIMULATED


class NoDevice(Exception):
    """There is no GPU, or none that numba can use; the message says why."""


class Columns:
    """A copy of an array (k, ..) on the device, whose first index is the last one in memory.

    `view` has the shape of the array. An array without numbers stays as it is: there is nothing to describe to others.
    """

    def __init__(self, array):
        self.is_empty = array.size == 0
        moved = np.ascontiguousarray(array if self.is_empty else np.moveaxis(array, 0, -1))
        self.on_device = moved if IS_SIMULATED else cuda.to_device(moved)

    @property
    def view(self):
        """The array (k, ..) for a kernel."""
        if self.is_empty:
            return self.on_device
        return np.moveaxis(self.on_device, -1, 0) if IS_SIMULATED else cuda.as_cuda_array(self)

    @property
    def __cuda_array_interface__(self):
        """The description of the view, which other packages read."""
        of = self.on_device
        described = dict(of.__cuda_array_interface__)
        described["shape"] = (of.shape[-1], *of.shape[:-1])
        described["strides"] = (of.strides[-1], *of.strides[:-1])
        return described

    @classmethod
    def without_numbers(cls, shape):
        """Return Columns of a new array (k, ..) on the device, which holds NaN."""
        columns, own = cls(np.empty(shape if 0 in shape else 0)), (*shape[1:], shape[0])
        if 0 not in shape:
            columns.is_empty = False
            columns.on_device = np.full(own, np.nan) if IS_SIMULATED else _filled(own, np.float64, np.nan)
        return columns

    def fetched(self):
        """Return a copy (k, ..) in the memory of the process."""
        array = self.on_device if IS_SIMULATED else self.on_device.copy_to_host()
        return array if self.is_empty else np.moveaxis(array, -1, 0)


class Kept(NamedTuple):
    """An array (k, ..) that stays on the device, in place of Columns; its `view` is itself."""

    view: object


def fetched(array):
    """Return a contiguous copy, in the memory of the process, of an array on the device, as of torch, JAX and CuPy."""
    if not IS_SIMULATED:
        return np.ascontiguousarray(cuda.as_cuda_array(array).copy_to_host())
    if hasattr(array, "__cuda_array_interface__"):
        array = SimpleNamespace(__array_interface__=array.__cuda_array_interface__)
    return np.array(array, order="C")


def viewed(columns):
    """Return a tuple of Columns as a tuple of their views, of the same type."""
    views = [own.view for own in columns]
    return type(columns)(*views) if hasattr(columns, "_fields") else tuple(views)


def require_device():
    """Raise NoDevice unless there is a GPU that numba can use."""
    if IS_SIMULATED:
        return
    try:
        cuda.current_context()
    except Exception as error:
        raise NoDevice(" ".join(str(error).split())) from None


def free_memory():
    """Return the number of free bytes on the device."""
    return 1 << 30 if IS_SIMULATED else int(cuda.current_context().get_memory_info().free)


def sent(value):
    """Return a tuple of tuples with all its arrays on the device."""
    if isinstance(value, np.ndarray):
        return value if IS_SIMULATED else cuda.to_device(value)
    if isinstance(value, tuple):
        items = [sent(item) for item in value]
        return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    return value


def work_space(value, threads):
    """Return a tuple of tuples with an array (.., threads) of zeros on the device in place of each array (..,)."""
    if isinstance(value, np.ndarray):
        shape = *value.shape, threads
        return np.zeros(shape, value.dtype) if IS_SIMULATED else _filled(shape, value.dtype, 0)
    if isinstance(value, tuple):
        items = [work_space(item, threads) for item in value]
        return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    return value


def _filled(shape, dtype, value):
    """Return a new array on the device, whose numbers all have the same value."""
    array = cuda.device_array(shape, dtype)
    if array.size:
        flat = array.reshape(array.size)
        _fill[min(1024, -(-array.size // 256)), 256](flat, value)
    return array


@cuda.jit
def _fill(array, value):
    for i in range(cuda.grid(1), array.size, cuda.gridsize(1)):
        array[i] = value
