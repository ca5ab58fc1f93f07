"""What the machine can do at most: memory bandwidth, matrix products, rays.

A program that has to read so many bytes, or to multiply so many numbers, cannot be quicker than these.
"""

import functools
import os
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.scene import scene
from envedit.transport import sparse_matrix

from . import network
from .timing import side_by_side

SHAPES = ((256, 16384), (128, 16384), (64, 16384))
"""(width, points) of the hidden layers: the paper's network, the standard one, the draft's."""


def measure(settings, quick: bool = False) -> dict:
    """Return the rows of the tables ``bandwidth``, ``matmul`` and ``rays``."""
    memory = bandwidth(1 << 20 if quick else None)
    sizes = {key: memory[key] for key in ("array_bytes", "cache_bytes")}
    return {
        "bandwidth": [{"streaming": name, "rate": rate} | sizes for name, rate in memory["rates"].items()],
        "matmul": matmul(((16, 256),) if quick else SHAPES),
        "rays": rays(1 << 12 if quick else 1 << 20),
    }


def bandwidth(elements: int | None = None) -> dict:
    """Measure bytes a second between memory and cores, on float32 arrays larger than the caches.

    ``elements`` is the number of floats in an array; by default of twice the largest cache, 256 MiB or more,
    but at most a sixteenth of the memory.

    Returns ``array_bytes``, ``cache_bytes``; ``rates``: bytes a second by name; ``read``: the best of those
    that only read, which is the floor that reading T is held against. A triad a = b + s c counts 12 bytes an
    element: what the processor reads of ``a`` before it writes there is not counted (McCalpin's STREAM).
    """
    cache = largest_cache()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    elements = elements or min(max(2 * (cache or 0), 256 << 20), memory // 16) // 4
    b = dr.opaque(mi.Float, 1.5, elements)
    c = dr.opaque(mi.Float, 0.25, elements)
    s = dr.opaque(mi.Float, 3)
    lanes = sparse_matrix.SLICE * 512  # enough for any number of cores; each lane then reads a long row
    rows = dr.opaque(mi.UInt32, elements // 4 // lanes)
    jobs = {  # bytes an element, and what is timed
        "Dr.Jit sum": (4, lambda: dr.sum(b)),
        "Dr.Jit packets": (4, lambda: _read_packets(b, rows, lanes)),
        "Dr.Jit triad": (12, lambda: b + s * c),
    }
    taken = side_by_side({name: job for name, (_, job) in jobs.items()})
    rates = {name: size * elements / taken[name]["min_s"] for name, (size, _) in jobs.items()}
    read = max(rate for name, rate in rates.items() if jobs[name][0] == 4)
    return {"array_bytes": 4 * elements, "cache_bytes": cache, "rates": rates, "read": read}


@dr.syntax
def _read_packets(packed, rows, lanes):
    """Sum packets in the order in which a product with T reads its own, but without reading a map."""
    lane = dr.arange(mi.UInt32, lanes)
    place = (lane // sparse_matrix.SLICE) * (rows * sparse_matrix.SLICE) + lane % sparse_matrix.SLICE
    total = mi.Vector4f(0)
    done = dr.zeros(mi.UInt32, lanes)
    while done < rows:
        total += dr.gather(mi.Vector4f, packed, place)
        place += sparse_matrix.SLICE
        done += 1
    return total


def largest_cache() -> int | None:
    """Return the size of the processor's largest cache in bytes; None where the system does not report it."""
    found = []
    for file in Path("/sys/devices/system/cpu/cpu0/cache").glob("index*/size"):
        text = file.read_text().strip()
        unit = {"K": 2**10, "M": 2**20, "G": 2**30}.get(text[-1:], 1)
        found.append(int(text.rstrip("KMG")) * unit)
    return max(found, default=None)


def matmul(shapes=SHAPES) -> list[dict]:
    """Measure Dr.Jit's matrix products of a hidden layer: forward, and the two of the reverse pass.

    Returns a row for each shape and layout: ``width``, ``points``, ``layout`` ("rows": a point a row), and
    for each product GFLOP/s, of the median.
    """
    found = []
    rng = np.random.default_rng(0)
    for width, points in shapes:
        jobs = {}
        for layout in network.LAYOUTS:
            for product, a, b, flags in network.products(layout, points, width, width):
                operands = network.operand(rng, a), network.operand(rng, b)
                jobs[layout, product] = functools.partial(dr.matmul, *operands, **flags)
        taken = side_by_side(jobs)
        for layout in network.LAYOUTS:
            rates = {
                p: 2e-9 * width**2 * points / t["median_s"] for (of, p), t in taken.items() if of == layout
            }
            found.append({"width": width, "points": points, "layout": layout} | rates)
    return found


def rays(count: int = 1 << 20) -> list[dict]:
    """Measure rays a second in the scene ``sphere``: coherent or not, nearest hit or any."""
    lit = scene.load("sphere", 256)
    rng = np.random.default_rng(0)
    across = dr.opaque(mi.Point2f(*(mi.Float(rng.random(count, np.float32)) for _ in range(2))))
    camera, _ = lit.mi.sensors()[0].sample_ray(0, 0, across, mi.Point2f(0.5))
    origins = rng.uniform((-2, 0.01, -2), 2, (count, 3)).astype(np.float32).T
    ways = rng.normal(size=(3, count)).astype(np.float32)
    origins = mi.Point3f(*map(mi.Float, origins))
    ways = mi.Vector3f(*map(mi.Float, ways))
    camera = dr.opaque(mi.Ray3f(camera))
    scattered = dr.opaque(mi.Ray3f(origins, dr.normalize(ways)))
    taken = side_by_side(
        {
            "from the camera, nearest hit": lambda: lit.mi.ray_intersect(camera).t,
            "from anywhere, nearest hit": lambda: lit.mi.ray_intersect(scattered).t,
            "from anywhere, any hit": lambda: lit.mi.ray_test(scattered),
        }
    )
    return [
        {"rays": name, "count": count, "rate": count / found["median_s"]} for name, found in taken.items()
    ]
