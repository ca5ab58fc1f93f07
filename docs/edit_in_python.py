"""Edit a sky from Python: a scene, its light transport, a target as an array, a figure, a folder of results.

Opens as a notebook in editors that know ``# %%`` cells, and runs as a script, in seconds.
"""

# %% A scene and a sky: linear radiance (32, 64, 3), row 0 the zenith. load_map("sky.hdr") reads a file.
import numpy as np

import envedit

scene = envedit.load_scene("sphere", width=64)
sky = envedit.sunsky(64, azimuth=240, elevation=45)

# %% The light transport T: a rendering is T E. Traced once; the sun's texels are made exact for this sky.
transport = envedit.LightTransport.build(scene, height=32, width=64, spp=64)
transport = transport.resolved(sky)
initial = transport.apply(sky).numpy()
print(f"rendering {initial.shape}; {(transport.influence > 0).mean():.0%} of the texels light something")

# %% The target: the same scene as it looks in the evening, under another sky.
target = scene.render(envedit.sunsky(64, azimuth=150, elevation=20), spp=64)

# %% Edit until the scene renders like the target. The mask says that all of the picture counts.
settings = {"preset": "draft", "input": {"width": 64}, "target": {"spp": 64}, "output": {"spp": 64}}
whole = np.ones(target.shape[:2])
result = envedit.edit(settings, scene=scene, envmap=sky, target=target, mask=whole)
print(result)

# %% Renderings over their maps (matplotlib), and what a run of the command line leaves.
result.plot().savefig("edit.png")
result.save("edit")
