"""What only the CPU's backend has: bits that are the same from kernel to kernel, and its own memory."""

import os

import pytest

on_cpu = pytest.mark.skipif(
    os.environ.get("ENVEDIT_VARIANT", "llvm_ad_rgb") != "llvm_ad_rgb",
    reason="of the CPU's backend: a GPU rounds otherwise in every kernel, and has memory of its own",
)
