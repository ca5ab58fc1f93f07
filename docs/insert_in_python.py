"""Put an object into a photograph: find the photograph's light, then add what the object changes.

Opens as a notebook in editors that know ``# %%`` cells, and runs as a script, in seconds.
"""

# %% A photograph, taken here by Mitsuba: a ball on a plane, under a sun that nobody tells, filmic and warm.
from pathlib import Path

import numpy as np

import envedit
from envedit.core import shipped
from envedit.images import images
from envedit.targets.photo import Camera

SIZE = 40
true = envedit.sunsky(64, azimuth=150, elevation=30)
taken = envedit.load_scene("sphere", width=2 * SIZE).render(true, spp=64)
phone = Camera("filmic", np.log([3.6, 3.0, 2.1]))
images.write_png("photograph.png", phone.shown(taken))

# %% Its light: the map that explains it, from any sky, and a scene that has what the photograph shows.
sky = envedit.sunsky(64, azimuth=240, elevation=45)
settings = {
    "preset": "draft",
    "input": {"width": 64},
    "scene": {"file": "sphere", "width": SIZE},
    "target": {"kind": "photo", "file": "photograph.png", "spp": 64},
    "representation": {"turn": False},  # only the sun moves, which is quicker to find
    "output": {"spp": 64},
}
result = envedit.edit(settings, envmap=sky)
result.save("matched")
photo = result.photo
print(photo.summary)

# %% The scene with the object, and the object alone, where light is not seen: its outline.
scene = (shipped.folder() / "sphere.xml").read_text()
stage, rest = scene.split('<shape type="rectangle"')
box = """<shape type="cube">
    <transform name="to_world">
        <scale value="0.3"/> <rotate y="1" angle="30"/> <translate x="1.1" y="0.3" z="1.5"/>
    </transform>
    <bsdf type="diffuse"> <rgb name="reflectance" value="0.7, 0.1, 0.08"/> </bsdf>
</shape>
</scene>"""
hidden = '<integrator type="path"> <boolean name="hide_emitters" value="true"/> </integrator>'
Path("with_box.xml").write_text(scene.replace("</scene>", box))
Path("only_box.xml").write_text(stage + hidden + box)

# %% What it changes: shadows and light that it reflects, as a factor; its own pixels are the rendering's.
light = result.maps["edited"]
without, with_box = (
    envedit.load_scene(file, width=SIZE).render(light, spp=64) for file in ("sphere", "with_box.xml")
)
outline = envedit.load_scene("only_box.xml", width=SIZE).alpha[..., None]
beside = photo.picture * with_box / np.maximum(without, 1e-6)
composed = outline * with_box + (1 - outline) * beside
images.write_png("inserted.png", photo.camera.shown(composed * photo.let_through))
