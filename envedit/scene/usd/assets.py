"""Files that a USD stage names: textures on the disk, or inside a .usdz package."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

from pxr import Ar

from envedit.scene.usd.description import Description


def texture_file(scene: Description, path: Any, asset: Any) -> str:
    """Return the name of a texture's file as the XML has it: an absolute path, or a copy out of a package.

    ``path`` (pxr.Sdf.Path) is the prim that names it, ``asset`` (pxr.Sdf.AssetPath) its value. InputError if
    there is no such file.
    """
    resolved = asset.resolvedPath
    if not resolved:
        what = "tiles (UDIM) are not read" if "<UDIM>" in asset.path else "the file is missing"
        raise scene.error(path, f"texture {asset.path}: {what}")
    if not Ar.IsPackageRelativePath(resolved):
        if not os.path.isfile(resolved):
            raise scene.error(path, f"texture {asset.path}: the file is missing")
        scene.textures.add(os.path.abspath(resolved))
        return os.path.abspath(resolved)
    opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved))
    if not opened:
        raise scene.error(path, f"texture {asset.path}: the file is missing in the package")
    inner = Ar.SplitPackageRelativePathInner(resolved)[1]
    short = hashlib.sha256(resolved.encode()).hexdigest()[:8]
    copy, name = scene.new_file(f"{short}_{Path(inner).name}")
    copy.write_bytes(opened.GetBuffer())
    return name
