"""Paint on a rendering and get the map: envedit with arrays, cell by cell.

Opens as a notebook in editors that know ``# %%`` cells, and runs as a script.
"""

# %% A scene under a sky, at a small size so that every cell takes seconds.
import mitsuba as mi
import numpy as np

import envedit
from envedit import config, inputs
from envedit.targets import initial_rendering

mi.set_variant("llvm_ad_rgb")
settings = config.loads(
    """
    preset = "draft"
    [input]
    width = 64
    azimuth = 240.0
    elevation = 45.0
    [scene]
    file = "sphere"
    width = 64
    [target]
    spp = 64
    [output]
    spp = 64
    """
)

# %% The rendering under the map as it is: what there is to paint on.
sky, _ = inputs.load_map(settings.input)
lit = inputs.load_scene(settings.scene)
initial = initial_rendering.initial(lit, sky, settings)
print(f"initial rendering {initial.shape}, mean radiance {initial.mean():.3f}")

# %% Paint: the lower right corner, where the shadow falls, becomes warmer and brighter.
picture = initial.copy()
picture[36:44, 44:60] *= [1.5, 1.25, 1.0]

# %% Edit. What differs from the initial rendering is taken as painted; a mask would say it explicitly.
result = envedit.edit(settings, target=picture)
asked = result.metrics["painted"]
print("\n".join(result.notes))
reached, within = 100 * asked["towards"], 100 * asked["reachable"]
print(f"{reached:.0f} % of the painted change reached; {within:.0f} % is feasible under any map")
print(f"the rest changed by {asked['elsewhere']:.4f} on average (display values)")

# %% The edited map, linear radiance, and the rendering that Mitsuba makes of it with fresh samples.
brightest = [np.unravel_index(m.argmax(), m.shape)[:2] for m in (sky, result.envmap)]
print(f"map {result.envmap.shape}; brightest texel {brightest[0]} before, {brightest[1]} after")
print(f"rendering {result.render.shape}")
