"""Blender extension: a panel *Environment light* in the World tab that edits the world's map with envedit.

Its operators export the scene (``exchange``) to a new folder, start envedit there as a process of its own,
and watch its results.
"""

import subprocess
from dataclasses import dataclass
from pathlib import Path

import bpy
from bpy.props import BoolProperty, IntProperty, PointerProperty, StringProperty

from . import exchange

POLL_SECONDS = 0.5
RESULTS = "shot_out"
COMPLETE = "metrics.json"
"""What envedit writes last to the folder of its results."""
LOG = "envedit.log"


@dataclass
class Edit:
    """A running envedit: its process, its folder, its scene, and which results were taken."""

    process: subprocess.Popen
    folder: Path
    scene: str
    taken: int = 0

    def saved(self) -> int:
        """Return when results were completed last, or 0."""
        try:
            return (self.folder / RESULTS / COMPLETE).stat().st_mtime_ns
        except OSError:  # envedit moves it away before it writes another
            return 0

    def error(self) -> str:
        """Return the last line that envedit wrote to stderr."""
        lines = (self.folder / LOG).read_text(encoding="utf-8", errors="replace").split("\n")
        return next((line for line in reversed(lines) if line.strip()), f"envedit ended, see {self.folder}")


_running: list[Edit] = []  # at most one


def poll() -> float | None:
    """Look at the running edit; as a timer of Blender, return the seconds to the next look or None."""
    if not _running:
        return None
    edit = _running[0]
    code = edit.process.poll()
    if code is not None:
        _running.clear()
    saved = edit.saved()
    if saved not in (0, edit.taken):
        edit.taken = saved
        _report(scene=edit.scene, folder=str(edit.folder))
    elif code:
        _report(error=f"exit code {code}: {edit.error()}")
    return POLL_SECONDS if code is None else None


def _report(**what):
    """Call the operator that takes an edit or reports an error, in a window where there is one."""
    if bpy.app.background:
        bpy.ops.envedit.take("EXEC_DEFAULT", True, **what)
    else:
        with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
            bpy.ops.envedit.take("INVOKE_DEFAULT", **what)


def _start(context, arguments):
    """Export the scene to a new folder and start envedit there."""
    settings = context.scene.envedit
    if settings.folder.startswith("//") and not bpy.data.filepath:
        raise exchange.ExchangeError("save the .blend file first, or choose a folder of results")
    parent, number = Path(bpy.path.abspath(settings.folder)), 1
    while any((folder := parent / f"edit_{number}").glob("*")):
        number += 1
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise exchange.ExchangeError(f"{folder}: {error.strerror}; choose another folder") from error
    exchange.export(context.scene, folder / "shot.usdc", settings.camera)
    (folder / "shot.toml").write_text(f'[scene]\nfile = "shot.usdc"\nwidth = {settings.width}\n')

    # ---- envedit: its command, or the Python that has it
    program = bpy.path.abspath(context.preferences.addons[__package__].preferences.command)
    module = ["-m", "envedit"] if Path(program).stem.lower().startswith("python") else []
    try:
        with (folder / LOG).open("w") as log:
            process = subprocess.Popen(
                [program, *module, *arguments], cwd=folder, stdin=subprocess.DEVNULL, stderr=log
            )
    except OSError as error:
        how = "name the command envedit, or its Python, in the preferences of the extension"
        raise exchange.ExchangeError(f"{program}: {error.strerror}; {how}") from error
    _running.append(Edit(process, folder, context.scene.name))
    if not bpy.app.timers.is_registered(poll):
        bpy.app.timers.register(poll, first_interval=POLL_SECONDS)


def _end():
    for edit in _running:
        edit.process.terminate()
    _running.clear()


class EnveditPreferences(bpy.types.AddonPreferences):
    """Where envedit is."""

    bl_idname = __package__

    command: StringProperty(
        name="envedit",
        description="The command envedit, or the Python that it is installed in",
        subtype="FILE_PATH",
        default="envedit",
    )

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.prop(self, "command")


class EnveditSettings(bpy.types.PropertyGroup):
    """Settings of a scene's edits."""

    camera: PointerProperty(
        name="Camera",
        description="Whose picture is edited: the scene's camera, if empty",
        type=bpy.types.Object,
        poll=lambda self, thing: thing.type == "CAMERA",
    )
    width: IntProperty(name="Width", description="Pixels of the picture", default=128, min=4, max=4096)
    target: StringProperty(
        name="Target image",
        description="Picture of the scene under other light, or a lat-long map to light it by",
        subtype="FILE_PATH",
    )
    folder: StringProperty(
        name="Folder", description="For a folder of every edit", subtype="DIR_PATH", default="//envedit/"
    )
    lamps: BoolProperty(
        name="Lights as sun lamps",
        description="Take lights of the edited map as sun lamps, and its sky, 256 texels wide, as world",
    )


class _Start(bpy.types.Operator):
    @classmethod
    def poll(cls, context):
        return not _running

    def execute(self, context):
        try:
            _start(context, self.arguments(context.scene.envedit))
        except exchange.ExchangeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class ENVEDIT_OT_paint(_Start):
    """Paint on the camera's picture in the browser; Save there sets the world."""

    bl_idname = "envedit.paint"
    bl_label = "Paint"

    def arguments(self, settings: EnveditSettings) -> list[str]:
        return ["paint", "shot.toml", "--port", "0"]


class ENVEDIT_OT_match(_Start):
    """Edit the world so that the camera's picture is like the target image."""

    bl_idname = "envedit.match"
    bl_label = "Match target image"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return super().poll(context) and bool(context.scene.envedit.target)

    def arguments(self, settings: EnveditSettings) -> list[str]:
        target, width = bpy.path.abspath(settings.target), f"scene.width={settings.width}"
        return ["run", "shot.usdc", "--target", target, "--set", width, "--out", RESULTS, "--quiet"]


class ENVEDIT_OT_take(bpy.types.Operator):
    """Set the world to the edited map."""

    bl_idname = "envedit.take"
    bl_label = "Edit of the environment light"
    bl_options = {"INTERNAL", "UNDO"}

    scene: StringProperty()
    folder: StringProperty()
    error: StringProperty()

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        # Of what a timer calls, reports are not shown and no undo step is made: wait for the event loop.
        self._timer = context.window_manager.event_timer_add(0.01, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        context.window_manager.event_timer_remove(self._timer)
        return self.execute(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            if self.error:
                raise exchange.ExchangeError(self.error)
            scene = bpy.data.scenes.get(self.scene)
            if scene is None:
                raise exchange.ExchangeError(f"no scene {self.scene} now; the edit is in {self.folder}")
            settings, results = scene.envedit, Path(self.folder) / RESULTS
            exchange.take(scene, results, settings.lamps, settings.folder.startswith("//"))
        except exchange.ExchangeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"the world is the edited map of {self.folder}")
        return {"FINISHED"}


class ENVEDIT_OT_end(bpy.types.Operator):
    """End the running envedit; what it has saved stays."""

    bl_idname = "envedit.end"
    bl_label = "End envedit"

    def execute(self, context: bpy.types.Context) -> set[str]:
        _end()
        return {"FINISHED"}


class ENVEDIT_PT_light(bpy.types.Panel):
    """The panel in the World tab."""

    bl_label = "Environment light"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "world"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.envedit
        for name in ("camera", "width", "folder", "lamps"):
            layout.prop(settings, name)
        layout.operator("envedit.paint", icon="BRUSH_DATA")
        layout.prop(settings, "target")
        layout.operator("envedit.match", icon="IMAGE_DATA")
        if _running:
            layout.label(text=f"envedit runs in {_running[0].folder}")
            layout.operator("envedit.end", icon="X")


CLASSES = (
    EnveditPreferences,
    EnveditSettings,
    ENVEDIT_OT_paint,
    ENVEDIT_OT_match,
    ENVEDIT_OT_take,
    ENVEDIT_OT_end,
    ENVEDIT_PT_light,
)


def register() -> None:
    """Add the extension to Blender."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.envedit = PointerProperty(type=EnveditSettings)


def unregister() -> None:
    """End what runs, and remove the extension."""
    _end()
    del bpy.types.Scene.envedit
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
