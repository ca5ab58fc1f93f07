"""The thread that owns Dr.Jit, and the queue before it: of each kind of request, the latest wins."""

from __future__ import annotations

import contextlib
import re
import sys
import threading
import traceback
from pathlib import Path

from envedit.cli import run
from envedit.cli.paint import project, taken_files
from envedit.cli.paint.protocol import ApplyLook, Choose, Edit, Open, Pick, Save, Sky
from envedit.cli.paint.session import Session, SupersededError, Tell
from envedit.core.errors import EnveditError, InputError, unwrapped
from envedit.maps import look_transfer, looks, map_file
from envedit.targets.strokes import gains

ORDER = (Open, ApplyLook, Pick, Edit, Choose, Sky, Save)
"""Of requests that wait, which kind goes first: what is saved has all edits."""


WHITES = [round(1e6 / mired, 1) for mired in range(40, 501, 10)]
"""Kelvin of the black bodies that colours of lights are compared with, 10 mired apart: the page goes between
them."""


class Again:
    """A page has come: show it everything."""


class Refused:
    """A message of a page was refused: send it what is painted, which the page may show otherwise."""


class Worker(threading.Thread):
    """Carries requests out, one at a time, and what goes on between them; ``tell`` receives every message."""

    def __init__(self, tell: Tell, opened: project.Project | None = None):
        super().__init__(name="envedit-paint", daemon=True)
        self.tell, self._opened = tell, opened
        self.session: Session | None = None
        self._waiting: dict[type, object] = {}
        self._lock = threading.Condition()
        self._over = self._owed = False
        self._painting = 0
        self._held = contextlib.ExitStack()  # the folder of the painting that is open
        self.faults: list[Exception] = []  # of ours, no user's mistakes

    def post(self, request: object) -> None:
        """Let a request wait, in the place of an earlier one of its kind."""
        with self._lock:
            self._waiting[type(request)] = request
            self._lock.notify()

    def stop(self) -> None:
        """End after what is going on; safe to call twice."""
        with self._lock:
            self._over = True
            self._lock.notify()

    @property
    def newer(self) -> bool:
        """Whether something waits."""
        return self._over or bool(self._waiting)

    def run(self) -> None:
        """Work until :meth:`stop`."""
        try:
            self._work()
        finally:
            self._held.close()

    def _work(self):
        if self._opened is not None:
            self._attempt(lambda: self._open(self._opened))
        busy = self.session is not None
        while not self._over:
            with self._lock:
                while not (self._waiting or busy or self._over):
                    self._lock.wait()
                kinds = [kind for kind in (*ORDER, Refused, Again) if kind in self._waiting]
                owed, self._owed = self._owed and busy, False
                request = self._waiting.pop(kinds[0]) if kinds and not owed else None
            if self._over:
                return
            if request is not None:
                # Pointer moves come faster than they are painted: each is followed by a step, or none were.
                self._owed = isinstance(request, Edit) and request.phase == "drawing"
                self._attempt(lambda request=request: self._carry_out(request))
                busy = self.session is not None
            else:
                busy = self.session is not None and bool(self._attempt(self.session.advance))

    def _carry_out(self, request):
        if isinstance(request, Open):
            self._open_next(project.opened(request.name, request.envmap))
        elif self.session is None:
            if not isinstance(request, Again | Refused):
                self.tell.say({"type": "error", "text": "no scene is open: open one first"})
        elif isinstance(request, Edit):
            if request.painting in (0, self._painting):
                self.session.update(request)
        elif isinstance(request, Refused):
            self.session.tell_document()
        elif isinstance(request, Pick):
            self.session.pick(request)
        elif isinstance(request, Choose):
            self.session.choose(request.explanation)
        elif isinstance(request, ApplyLook):
            self._apply(request)
        elif isinstance(request, Sky):
            self.session.sky()
        elif isinstance(request, Save):
            self.session.give_up_unfinished()
            self.tell.say({"type": "status", "state": "saving", "text": "saving"})
            try:
                self.session.save()
            finally:
                self.session.tell_state()
        else:
            self.session.give_up_unfinished()
            self.session.again()

    def _apply(self, request):
        """Open the painting on the map in the light of a look, which is written among the maps."""
        session, look = self.session, looks.parse(request.text, request.name)
        self.tell.say({"type": "status", "state": "loading", "text": f"Applying {request.name} to the map"})
        given = session.given.at_file_size(session.project.settings.input)
        edited = given.as_stored(look_transfer.apply(given.radiance, look))
        plain = re.sub(r"[^\w-]", "_", Path(request.name).stem)
        name = f"{Path(given.source).stem}_{plain}.exr"
        try:
            part = taken_files.part(name)
            with contextlib.ExitStack() as stack:
                stack.callback(part.unlink, missing_ok=True)
                warnings = map_file.write(part, edited, given)
                file = taken_files.place(part, name)
        except OSError as error:
            raise InputError(f"{taken_files.MAPS}/{name}: not written: {error.strerror}") from None
        self._open_next(project.on_another_map(session.project, session.finished, file))
        said = [f"The map has the light of {request.name}: {file}", *warnings]
        self.tell.say({"type": "note", "text": ". ".join(said)})

    def _open_next(self, opened):
        before = self.session
        self._open(opened)
        if before is not None:
            with self._lock:  # what came meanwhile is about what was open before
                for kind in (Edit, Pick, Choose, Sky, Save):
                    self._waiting.pop(kind, None)

    def _open(self, opened):
        """Open a painting in the place of the one that is open, which stays if that fails."""
        import mitsuba as mi

        from envedit.cli import doctor

        before, variant = self.session, mi.variant()
        again = before is not None and before.project.folder == opened.folder
        try:
            with contextlib.ExitStack() as stack:
                if not again:
                    stack.enter_context(opened.alone())
                doctor.select(opened.settings.variant)
                session = Session(opened, self.tell, lambda: self.newer)
                if not again:
                    self._held.close()
                    self._held = stack.pop_all()
        except BaseException:
            if before is not None:
                mi.set_variant(variant)
            raise
        self.session = session
        self._painting += 1
        project.note(opened)
        scene = run.scene_name(self.session.scene.path)
        self.tell.say(
            {
                "type": "opened",
                "painting": self._painting,
                "title": f"{scene}, {Path(opened.settings.input.envmap).name}",
                "folder": opened.folder.name,
                "views": [view.name for view in self.session.scene.views],
                "again": opened.again,
                "document": self.session.document.plain(),
                "width": self.session.scene.width,
                "height": self.session.scene.height,
                "notes": self.session.notes,
                "exposure": self.session.exposure,
                "hold": opened.settings.target.hold,
                "white": [[kelvin, *gains(kelvin).tolist()] for kelvin in WHITES],
            }
        )
        self.session.again()

    def _attempt(self, work):
        """Do something; a user's mistake is reported, as is a fault of ours, which also goes to stderr."""
        try:
            with unwrapped():
                return work()
        except SupersededError:
            return True
        except EnveditError as error:
            self.tell.say({"type": "error", "text": str(error)})
        except Exception as error:
            traceback.print_exc(file=sys.stderr)
            self.faults.append(error)
            self.tell.say({"type": "error", "text": f"{type(error).__name__}: {error}"})
        return None
