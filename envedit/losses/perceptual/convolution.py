"""Convolution with ReLU, max pooling and Hanning pooling, forward and back, natively in Dr.Jit.

Activations are flat arrays, channels together: a pixel a row of (H * W, C), as Dr.Jit multiplies tall
matrices fastest (``docs/decisions/network_layout.md``). A convolution gathers the patches under its kernel
into a matrix (pixels, taps * channels) and multiplies by the weights; its reverse multiplies by the weights
again and lets every input pixel gather what the windows over it hold. So nothing is added with atomics, and
the same run gives the same bits. Large images go through in bands of rows, so that the matrix of patches
stays below :data:`MOST_PATCHES`. Kernels take sizes as data: one serves all layers and all image sizes.

A layer has ``forward(x) -> output``, and those of VGG16 with Hanning pooling, DISTS's network, also
``backward(x, output, gradient) -> gradient of x``: all flat arrays without derivatives attached.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from envedit.core.types import DrArray, Shape, Tensor

MOST_PATCHES = 2**24
"""Numbers in a matrix of patches, at most (64 MB in single precision), but for a single row of an image."""


class Divisor:
    """Quotient and remainder by a number that is data.

    Dr.Jit turns division by a constant into a product, but a constant makes a kernel for every size of layer.
    In double precision floor((i + 1/2) / d) is exact for all 32-bit numbers.
    """

    def __init__(self, value: int):
        self.value = dr.opaque(mi.Int32, value)
        self._inverse = dr.opaque(mi.Float64, 1 / value)

    def split(self, i: DrArray) -> tuple[DrArray, DrArray]:
        """Return quotient and remainder of Int32 numbers that are not negative."""
        quotient = mi.Int32((mi.Float64(i) + 0.5) * self._inverse)
        return quotient, i - quotient * self.value


class _Windows:
    """Windows over an input (H, W, C): each gives one pixel of the output (Ho, Wo).

    Channels are read and written ``together``, by fours where there are fours; such a packet has one index.
    """

    def __init__(self, before, kernel, stride, padding):
        self.before = before
        self.after = after = tuple((n + 2 * padding - kernel) // stride + 1 for n in before[:2])
        self.kernel = kernel
        self.stride = stride
        self.together = 4 if before[2] % 4 == 0 else 1
        self.packets = before[2] // self.together
        sizes = *before[:2], *after, stride, padding
        self._h, self._w, self._h_after, self._w_after, self._s, self._p = (
            dr.opaque(mi.Int32, size) for size in sizes
        )
        divisors = self.packets, before[1], after[1], stride, kernel, kernel * kernel
        self._c, self._by_w, self._by_w_after, self._by_s, self._k, self._kk = map(Divisor, divisors)

    def read(self, source, index, active=True):
        """Read packets of a flat array; zeros where there is none."""
        F = type(source)
        if self.together == 4:
            F = dr.float64_array_t(mi.Vector4f) if F is dr.float64_array_t(F) else mi.Vector4f
        return dr.gather(F, source, mi.UInt32(index), active)

    def write(self, F, values, index):
        """Return packets, one for each index, as a flat array."""
        if self.together == 1:
            return values
        target = dr.empty(F, dr.width(index) * self.together)
        dr.scatter(target, values, mi.UInt32(index))
        return target

    def outputs(self):
        """Index of every output packet: its number, row, column, packet of channels."""
        i = dr.arange(mi.Int32, self.after[0] * self.after[1] * self.packets)
        pixel, c = self._c.split(i)
        return i, *self._by_w_after.split(pixel), c

    def inputs(self, first, rows):
        """Index of every input packet of some rows: its number, row, column, packet of channels."""
        i = dr.arange(mi.Int32, rows * self.before[1] * self.packets)
        pixel, c = self._c.split(i)
        row, column = self._by_w.split(pixel)
        return i, row + dr.opaque(mi.Int32, first), column, c

    def patches(self, first, rows):
        """Index of every packet under some rows of windows: its number, row, column, taps, channels."""
        taps = self.kernel * self.kernel
        i = dr.arange(mi.Int32, rows * self.after[1] * taps * self.packets)
        place, c = self._c.split(i)
        pixel, tap = self._kk.split(place)
        row, column = self._by_w_after.split(pixel)
        return i, row + dr.opaque(mi.Int32, first), column, *self._k.split(tap), c

    def under(self, row, column, tap_y, tap_x, c):
        """Index of the input packet under a tap of a window, and whether there is one."""
        y, x = row * self._s + tap_y - self._p, column * self._s + tap_x - self._p
        inside = (y >= 0) & (y < self._h) & (x >= 0) & (x < self._w)
        return (y * self._w + x) * self._c.value + c, inside

    def over(self, row, column):
        """Yield the windows over an input pixel: row, column, taps, and whether there is one."""
        (row, tap_y), (column, tap_x) = self._by_s.split(row + self._p), self._by_s.split(column + self._p)
        across = range(-(-self.kernel // self.stride))
        for j in across:
            y, ky = row - j, tap_y + j * self._s
            inside = (y >= 0) & (y < self._h_after) & (ky < self._k.value)
            for i in across:
                x, kx = column - i, tap_x + i * self._s
                yield y, x, ky, kx, inside & (x >= 0) & (x < self._w_after) & (kx < self._k.value)

    def output(self, row, column, c):
        """Index of an output packet."""
        return (row * self._w_after + column) * self._c.value + c

    def patch(self, row, column, tap_y, tap_x, c):
        """Index of a packet of the matrix of patches."""
        place = (row * self._w_after + column) * self._kk.value + tap_y * self._k.value + tap_x
        return place * self._c.value + c


class Convolution:
    """Convolution with zeros around the image, and ReLU."""

    def __init__(self, matrix: Tensor, bias: DrArray, before: Shape, kernel: int, stride: int, padding: int):
        self._matrix = matrix
        self._bias = bias
        self._kernel = kernel
        self._padding = padding
        self._columns = kernel * kernel * before[2]
        self._windows = _Windows(before, kernel, stride, padding)
        self._outputs = len(bias)
        self._by_outputs = Divisor(self._outputs)
        self.after: Shape = (*self._windows.after, self._outputs)
        self._rows = max(MOST_PATCHES // (self.after[1] * self._columns), 1)

    def forward(self, x: DrArray) -> DrArray:
        """Return max(W patches + bias, 0)."""
        windows = self._windows
        height = self.after[0]
        parts = []
        for first in range(0, height, self._rows):
            rows = min(self._rows, height - first)
            i, row, column, tap_y, tap_x, c = windows.patches(first, rows)
            under = windows.read(x, *windows.under(row, column, tap_y, tap_x, c))
            patches = windows.write(type(x), under, i)
            dr.eval(patches)
            product = dr.matmul(_rows_of(patches, self._columns), self._weights(type(x)), Bt=True).array
            _, channel = self._by_outputs.split(dr.arange(mi.Int32, len(product)))
            product += type(x)(dr.gather(mi.Float, self._bias, mi.UInt32(channel)))
            parts.append(dr.select(product < 0, 0, product))  # maximum may drop NaN
            dr.eval(parts[-1])
        return _joined(parts)

    def backward(self, x: DrArray, y: DrArray, gradient: DrArray) -> DrArray:
        """Pull a gradient back, of a stride of 1; where the ReLU gave 0, its slope is 0."""
        gradient = dr.select(y <= 0, 0, gradient)
        dr.eval(gradient)
        height = self._windows.before[0]
        parts = []
        for first in range(0, height, self._rows):
            stop = min(first + self._rows, height)
            low = max(first + self._padding - self._kernel + 1, 0)
            high = min(stop + self._padding, self.after[0])
            parts.append(self._pull(gradient, first, stop, low, high))
            dr.eval(parts[-1])
        return _joined(parts)

    def _weights(self, F):
        return self._matrix if F is type(self._matrix.array) else dr.tensor_t(F)(self._matrix)

    def _pull(self, gradient, first, stop, low, high):
        """Gradient of input rows first ... stop - 1, which the output rows low ... high - 1 depend on."""
        F = type(gradient)
        windows = self._windows
        i, row, column, c = windows.inputs(first, stop - first)
        if (low, high) != (0, self.after[0]):
            row_length = self.after[1] * self._outputs
            part = dr.arange(mi.UInt32, (high - low) * row_length) + dr.opaque(mi.UInt32, low * row_length)
            gradient = dr.gather(F, gradient, part)
        patches = dr.matmul(_rows_of(gradient, self._outputs), self._weights(F)).array
        total = 0
        low = dr.opaque(mi.Int32, low)
        for y, x, tap_y, tap_x, inside in windows.over(row, column):
            total += windows.read(patches, windows.patch(y - low, x, tap_y, tap_x, c), inside)
        return windows.write(F, total, i)


class MaxPool:
    """Max pooling, every second pixel."""

    def __init__(self, kernel: int, before: Shape):
        self._kernel = kernel
        self._windows = _Windows(before, kernel, 2, 0)
        self.after: Shape = (*self._windows.after, before[2])

    def forward(self, x: DrArray) -> DrArray:
        """Return the largest of every window, NaN where it has one."""
        windows = self._windows
        i, row, column, c = windows.outputs()
        best = windows.read(x, *windows.under(row, column, 0, 0, c))  # windows begin inside
        for tap in range(1, self._kernel**2):
            index, inside = windows.under(row, column, *divmod(tap, self._kernel), c)
            value = windows.read(x, index, inside)
            best = dr.select(inside & ((value > best) | dr.isnan(value)), value, best)
        pooled = windows.write(type(x), best, i)
        dr.eval(pooled)
        return pooled


class HanningPool:
    """L2 pooling of DISTS: sqrt(sum of w x^2 + 1e-12), w a 3 x 3 Hanning window, every second pixel."""

    def __init__(self, before: Shape):
        self._windows = _Windows(before, 3, 2, 1)
        self.after: Shape = (*self._windows.after, before[2])

    def forward(self, x: DrArray) -> DrArray:
        """Return the root of every window."""
        windows = self._windows
        total = 0
        i, row, column, c = windows.outputs()
        for tap in range(9):
            tap_y, tap_x = divmod(tap, 3)
            value = windows.read(x, *windows.under(row, column, tap_y, tap_x, c))
            total += _hanning(tap_y) * _hanning(tap_x) * value * value
        pooled = windows.write(type(x), dr.sqrt(total + 1e-12), i)
        dr.eval(pooled)
        return pooled

    def backward(self, x: DrArray, y: DrArray, gradient: DrArray) -> DrArray:
        """Pull a gradient back: w x / root, summed over the windows."""
        windows = self._windows
        total = 0
        quotient = gradient / y
        dr.eval(quotient)
        i, row, column, c = windows.inputs(0, windows.before[0])
        for y_, x_, tap_y, tap_x, inside in windows.over(row, column):
            weight = type(x)(_hanning(tap_y) * _hanning(tap_x))
            total += weight * windows.read(quotient, windows.output(y_, x_, c), inside)
        pulled = windows.write(type(x), windows.read(x, i) * total, i)
        dr.eval(pulled)
        return pulled


def _hanning(tap):
    """Weight of a tap: numpy.hanning(5)[1:-1], with sum one."""
    return dr.select(tap == 1, 0.5, 0.25)


def _rows_of(values, columns):
    return dr.tensor_t(type(values))(values, (len(values) // columns, columns))


def _joined(parts):
    return parts[0] if len(parts) == 1 else dr.concat(parts)
